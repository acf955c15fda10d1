from nlights_cosine import CosineBasis

from nlights_core.testing import IntegratorContract


class TestCosineBasis(IntegratorContract):
    algorithm = CosineBasis()
