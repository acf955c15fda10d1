"""The bundled algorithms, offered through the same door as anyone's."""

from collections.abc import Iterable

from nlights_core.algorithms import Algorithm
from nlights_core.registry import hookimpl


@hookimpl
def nlights_algorithms() -> Iterable[type[Algorithm]]:
    """Return every bundled algorithm, slot by slot."""
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

    return [
        MeasuredPoi,
        ChromeSphere,
        GivenDirections,
        PhotographedFlats,
        InverseSquare,
        LeastSquares,
        Progressive,
        RankTrim,
        MedianOfTriplets,
        Robust,
        FlatResidual,
        FrankotChellappa,
        Simchony,
        ParabolicFit,
        TiedToKnownHeights,
    ]
