"use strict";
// The curtains: all views of a tile share one divider and one pair of variants.
for (const tile of document.querySelectorAll("section.curtains")) {
  const slider = tile.querySelector("input[type=range]");
  const choices = [...tile.querySelectorAll("select")];
  const move = (percent) => {
    slider.value = Math.min(100, Math.max(0, percent));
    tile.style.setProperty("--cut", slider.value + "%");
  };
  const choose = () => {
    const [left, right] = choices.map((choice) => choice.value);
    for (const image of tile.querySelectorAll(".curtain img")) {
      image.classList.toggle("left", image.dataset.variant === left);
      image.classList.toggle("right", image.dataset.variant === right && right !== left);
    }
    choices.forEach((choice, i) => {
      const name = choice.options[choice.selectedIndex].textContent;
      for (const label of tile.querySelectorAll(i ? ".named-right" : ".named-left")) label.textContent = name;
    });
  };
  slider.addEventListener("input", () => move(slider.value));
  choices.forEach((choice) => choice.addEventListener("change", choose));
  for (const curtain of tile.querySelectorAll(".curtain")) {
    const follow = (event) => {
      const place = curtain.getBoundingClientRect();
      move((100 * (event.clientX - place.left)) / place.width);
    };
    curtain.addEventListener("pointerdown", (event) => {
      curtain.setPointerCapture(event.pointerId);
      follow(event);
      slider.focus({ preventScroll: true });
      event.preventDefault();
    });
    curtain.addEventListener("pointermove", (event) => {
      if (event.buttons & 1) follow(event);
    });
  }
  move(slider.value);
  choose();
  tile.classList.add("live"); // only now is there anything to operate
}
