from nlights_cosine import CosineBasis

from nlights_core.testing.contracts import IntegratorContract


class TestCosineBasis(IntegratorContract):
    algorithm = CosineBasis()
