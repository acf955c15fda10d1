"""Every bundled algorithm keeps the contract of its kind, like anyone's."""

import numpy as np
import pytest

from nlights_core import testing as contracts
from nlights_core.capture import GivenLights
from nlights_core.registry import installed
from nlights_plugins.chrome_sphere import ChromeSphere
from nlights_plugins.given_directions import GivenDirections
from nlights_plugins.height_detrends import ParabolicFit
from nlights_plugins.image_detrends import InverseSquare, PhotographedFlats
from nlights_plugins.integrators import FrankotChellappa, Simchony
from nlights_plugins.known_heights import TiedToKnownHeights
from nlights_plugins.least_squares import LeastSquares
from nlights_plugins.measured_poi import MeasuredPoi
from nlights_plugins.median_of_triplets import MedianOfTriplets
from nlights_plugins.normal_detrends import FlatResidual
from nlights_plugins.progressive import Progressive
from nlights_plugins.rank_trim import RankTrim
from nlights_plugins.robust import Robust


class TestMeasuredPoi(contracts.LightModelContract):
    algorithm = MeasuredPoi()


class TestMeasuredPoiWithEmission(contracts.LightModelContract):
    algorithm = MeasuredPoi(emission=True)


class TestPhotographedFlats(contracts.ImageDetrendContract):
    algorithm = PhotographedFlats()


class TestInverseSquare(contracts.ImageDetrendContract):
    algorithm = InverseSquare()


class TestLeastSquares(contracts.NormalSolverContract):
    algorithm = LeastSquares()


class TestProgressive(contracts.NormalSolverContract):
    algorithm = Progressive()


class TestRankTrim(contracts.NormalSolverContract):
    algorithm = RankTrim()


class TestMedianOfTriplets(contracts.NormalSolverContract):
    algorithm = MedianOfTriplets()


class TestRobust(contracts.NormalSolverContract):
    algorithm = Robust()


class TestFlatResidual(contracts.NormalDetrendContract):
    algorithm = FlatResidual()


class TestSimchony(contracts.IntegratorContract):
    algorithm = Simchony()


class TestSimchonyTrapezoid(contracts.IntegratorContract):
    algorithm = Simchony(stencil="trapezoid")


class TestFrankotChellappa(contracts.IntegratorContract):
    algorithm = FrankotChellappa()


class TestParabolicFit(contracts.HeightDetrendContract):
    algorithm = ParabolicFit()


class TestTiedToKnownHeights(contracts.HeightDetrendContract):
    algorithm = TiedToKnownHeights()


class TestGivenDirections(contracts.LightModelContract):
    algorithm = GivenDirections()

    @pytest.fixture(autouse=True)
    def _directions(self, tmp_path):
        self.file = tmp_path / "directions.txt"

    def tile(self):
        tile = super().tile()
        positions = tile.stand.lamp_positions(tile.lamps)
        np.savetxt(self.file, positions / np.linalg.norm(positions, axis=1, keepdims=True))
        return tile.model_copy(update={"lights": GivenLights(directions=self.file)})


def test_every_bundled_algorithm_has_its_contract_here():
    under_contract = {type(value.algorithm) for value in globals().values() if hasattr(value, "algorithm")}
    bundled = {offer.algorithm for offer in installed().offers() if offer.distribution == "nlights"}
    # The contract's tile has no photographed sphere; test_chrome_sphere.py makes its own.
    assert bundled - under_contract == {ChromeSphere}
