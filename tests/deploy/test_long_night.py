"""The long night of `make long-night`, with ten tiles: its looks, and the judge of them."""

import dataclasses

import fault_many
import pytest
from fault_evidence import FaultError


def test_a_night_of_ten_tiles_and_the_same_again(tmp_path, capsys):
    assert fault_many.main(["--tiles", "10", "--folder", str(tmp_path / "many")]) == 0, (
        capsys.readouterr().err
    )
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    assert len(rows) == 2 + 10 + 1


def test_what_grows_is_named():
    look = fault_many.Look(400, 450.0, 28, 6, 1.0, 882.0, 1000.0)
    looks = [look] * 4
    fault_many.require_flat([*looks, dataclasses.replace(look, tiles=1000, record=3000.0, memory=490.0)])
    for name, value in (("memory", 520.0), ("files", 40), ("threads", 7), ("page", 1000.0)):
        with pytest.raises(FaultError, match=f"{name} from .* to {value:.0f}"):
            fault_many.require_flat([*looks, dataclasses.replace(look, **{name: value})])
