"""For which processors loops are compiled."""

import pytest

from nlights_core.machine import kernel_cache, targets
from nlights_core.machine.targets import TARGETS, supported_targets


@pytest.fixture
def processor(monkeypatch, tmp_path):
    """Pretend to have a processor that knows some things, and that some targets are prepared."""
    binding = pytest.importorskip("llvmlite.binding")
    monkeypatch.delenv("NUMBA_CPU_NAME", raising=False)
    monkeypatch.delenv("NUMBA_CPU_FEATURES", raising=False)

    def pretend(known, prepared=()):
        monkeypatch.setattr(binding, "get_host_cpu_features", lambda: dict.fromkeys(known, True))
        monkeypatch.setattr(kernel_cache, "is_prepared", prepared.__contains__)
        supported_targets.cache_clear()
        return [target.name for target in supported_targets()], kernel_cache.chosen_target()

    yield pretend
    supported_targets.cache_clear()


V4, V3 = TARGETS


def test_a_young_processor_gets_the_fastest(processor):
    able, chosen = processor(V4.needed)
    assert able == ["x86-64-v4", "x86-64-v3"]
    assert chosen == V4


def test_what_is_prepared_goes_before_what_would_be_a_little_faster(processor):
    assert processor(V4.needed, ["x86-64-v3"])[1] == V3
    assert processor(V4.needed, ["x86-64-v3", "x86-64-v4"])[1] == V4


def test_a_processor_that_lacks_one_word_never_gets_code_that_has_it(processor):
    assert processor(V4.needed - {"avx512vbmi"})[1] == V3
    assert processor(V3.needed - {"fma"}, ["x86-64-v3", "x86-64-v4"]) == ([], None)
    assert processor({"neon"}) == ([], None)


def test_who_names_a_processor_gets_what_the_compiler_makes_for_it(processor, monkeypatch):
    monkeypatch.setenv("NUMBA_CPU_NAME", "znver4")
    assert processor(V4.needed) == ([], None)


def test_this_machine_can_be_asked():
    supported_targets.cache_clear()
    assert set(supported_targets()) <= set(targets.TARGETS)
