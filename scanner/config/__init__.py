"""One YAML file describes a bench and a scan: its models, its loading, and what an operator is told when it is wrong.

A file has the sections ``bench`` (which kind of bench, and that kind's own settings), ``rig``, ``scan``,
``gates`` and ``output``. Every mistake is a `Problem` with file, line, column and field, what was found and
expected, and a remedy; one `ConfigError` tells all mistakes of a file at once. Bench kinds are found by name in
the entry-point group ``scanner.benches``, so that any installed package can add one.
"""

from scanner.config.benches import BENCH_GROUP, bench_kinds, load_bench_kind
from scanner.config.loading import LoadedConfig, load_config, open_bench
from scanner.config.methods import METHOD_GROUP, METHOD_NAMES, load_stranger, method_names, register_file
from scanner.config.models import (
    BenchSection,
    CompareSection,
    Config,
    FrequenciesByAxis,
    GatesSection,
    OutputSection,
    PeriodsByAxis,
    ScanSection,
    WindowSection,
    check_plan_covers,
)
from scanner.config.problems import ConfigError, Problem
from scanner.config.schema import json_schema

__all__ = [
    "BENCH_GROUP",
    "METHOD_GROUP",
    "METHOD_NAMES",
    "BenchSection",
    "CompareSection",
    "Config",
    "ConfigError",
    "FrequenciesByAxis",
    "GatesSection",
    "LoadedConfig",
    "OutputSection",
    "PeriodsByAxis",
    "Problem",
    "ScanSection",
    "WindowSection",
    "bench_kinds",
    "check_plan_covers",
    "json_schema",
    "load_bench_kind",
    "load_config",
    "load_stranger",
    "method_names",
    "open_bench",
    "register_file",
]
