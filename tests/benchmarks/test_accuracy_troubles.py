"""Tables of the troubles: what counts as confidently wrong, and what a run that was cut off keeps."""

import json

import accuracy_troubles
import pytest
from accuracy_troubles import COVERED, SCENES, SEEDS, TROUBLES, Capture, confidently_wrong, coverage

SOUND = {
    "normals_coverage": 0.7,
    "height_coverage": 0.7,
    "height_rms_mm": 0.004,
    "level_error_mm": 0.09,
    "level_sd_mm": 0.05,
    "pixels": 100,
    "codes": [],
}


@pytest.mark.parametrize(
    "change",
    [
        {"height_coverage": 0.49},
        {"normals_coverage": 0.49},
        {"height_coverage": float("nan")},
        {"level_error_mm": -0.3},
    ],
)
def test_a_capture_is_confidently_wrong_where_nothing_warns(change):
    assert not confidently_wrong(SOUND)
    assert confidently_wrong(SOUND | change)
    assert not confidently_wrong(SOUND | change | {"codes": ["drift"]})


def test_a_level_that_was_not_measured_is_not_wrong():
    assert not confidently_wrong(SOUND | {"level_error_mm": 9.0, "level_sd_mm": None})


def test_figures_that_are_kept_are_pooled_and_not_measured_again(tmp_path, monkeypatch):
    lines = []
    for seed in SEEDS:
        scene = SCENES[seed % 4]
        for case in COVERED:
            recipe = "aligned" if case.align else "default"
            good = seed != SEEDS[3] or case != COVERED[4]
            figures = SOUND if good else SOUND | {"pixels": 300, "height_coverage": 0.4, "level_sd_mm": 0.01}
            lines.append({"capture": Capture(case, *scene, 360, seed, recipe).key(), "figures": figures})
    kept = tmp_path / "kept.jsonl"
    kept.write_text("".join(json.dumps(line) + "\n" for line in lines))
    monkeypatch.setattr(accuracy_troubles, "KEPT", kept)
    monkeypatch.setattr(accuracy_troubles, "measured", None)
    rows = coverage(False)[0].rows
    assert len(rows) == len(COVERED)
    title, count, normals, heights, span, _, levels, wrong = rows[4]
    assert (title, count, span, levels, wrong) == (COVERED[4].title, "20", "0.40 to 0.70", "19 of 20", "1")
    assert normals == pytest.approx(0.7)
    assert heights == pytest.approx((19 * 0.7 + 3 * 0.4) / 22)
    assert rows[0][-2:] == ("20 of 20", "0")


def test_troubles_have_titles_of_their_own():
    for cases in (TROUBLES, COVERED):
        assert len({case.title for case in cases}) == len({case.trouble for case in cases}) == len(cases)
