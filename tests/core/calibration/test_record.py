"""What a calibration leaves in the store is read back as it was, and a level only where it was measured."""

from dataclasses import replace

import numpy as np
import pytest

from nlights_core.calibration.record import (
    LARGEST,
    MISFIT,
    MODEL,
    read_calibration,
    read_uncertainty,
    write_calibration,
)


def test_what_all_share_is_read_back_as_it_was_written(varnished, tmp_path):
    _, scene = varnished
    write_calibration(tmp_path, scene.found, scene.errors, 0.02)
    known = read_calibration(tmp_path)
    np.testing.assert_array_equal(known.shared.vector(), scene.found.shared.vector())
    assert known.believed == scene.found.believed
    assert (known.residual, known.unreached) == (scene.errors.residual, 0.02)
    np.testing.assert_array_equal(np.load(tmp_path / "height.npy"), scene.found.height)
    np.testing.assert_array_equal(
        read_uncertainty(tmp_path), np.stack([scene.errors.height, scene.errors.slope])
    )


@pytest.mark.parametrize(
    ("sigma", "residual", "level", "stated"),
    [
        (0.1, 0.0, 0.0, 0.1),
        (0.03, 0.0, 10.0, float(np.hypot(0.03, 10 * MODEL))),
        (LARGEST + 0.01, 0.0, 0.0, None),
        (0.1, 1.1 * MISFIT, 0.0, None),
        (0.1, 0.0, 2 * LARGEST / MODEL, None),
    ],
)
def test_a_level_is_stated_where_it_was_measured(matt, tmp_path, sigma, residual, level, stated):
    _, scene = matt
    covariance = np.zeros_like(scene.found.covariance)
    covariance[0, 0] = sigma**2
    found = replace(scene.found, covariance=covariance, shared=replace(scene.found.shared, level=level))
    write_calibration(tmp_path, found, scene.errors._replace(residual=residual), 0.0)
    known = read_calibration(tmp_path)
    assert known.level_uncertainty == (None if stated is None else pytest.approx(stated))
    assert known.shared.level == level
