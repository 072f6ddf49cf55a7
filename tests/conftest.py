"""What all tests share; their fixtures are in `helpers/shared_fixtures.py`."""

import gc
import os
import sys
from pathlib import Path

import pytest
from hypothesis import settings
from template import TEMPLATE, template

# The examples of a test are the same ones every time and everywhere; `--hypothesis-profile=explore` draws new ones.
settings.register_profile("same", deadline=None, derandomize=True, database=None, max_examples=20)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.load_profile("same")


LONGEST = (
    "test_borders", "test_misbehaviour", "report/test_figures", "test_executors", "test_docs",
    "test_example_rope", "test_hertz3d", "test_conformance", "test_machines", "test_html_in_browser",
    "test_results_folder", "test_run", "test_supervisor", "test_c_source", "test_scaffold",
    "test_interruptions", "test_error_bounds", "test_html", "test_site", "test_keys",
    "test_paper_figures", "test_export", "test_invariance", "test_obstacle", "test_benchmarks", "test_any_text",
    "test_compare", "test_findings", "test_damaged_files", "test_packs", "test_as_published",
    "test_outputs_in_danger", "test_compilation", "test_correction", "test_faults", "test_formulations", "test_bounds",
    "test_other_codes", "test_database", "test_end_to_end",
)  # fmt: skip
"""Files that take longest, those first that wait more than they compute: parallel workers begin with them, so that all
end together, and only one of the first needs the run of `quick`, for which others would wait."""


TESTS = Path(__file__).resolve().parent

# Parallel workers import the same tests: their bytecode is kept, whatever the environment says.
sys.dont_write_bytecode = False


def pytest_configure(config: pytest.Config) -> None:
    """Let pytest-xdist, where it is, keep the order of the files; of its own it would begin with the most tests.

    Parallel workers begin to collect with different files, and find the bytecode of the others. They share a template.
    """
    config.option.loadscopereorder = False
    parallel = getattr(config, "workerinput", None)
    if parallel:
        gc.disable()  # until all tests are collected, which makes no garbage
    elif config.getoption("numprocesses", None):
        os.environ[TEMPLATE] = template()  # which the workers inherit
        return  # the process of the command runs no test, and all wait for it
    config.pluginmanager.import_plugin("shared_fixtures")
    if parallel and [Path(given).resolve() for given in config.args] == [TESTS]:
        files = sorted(map(str, TESTS.rglob("test_*.py")))
        begin = int(parallel["workerid"].removeprefix("gw")) * len(files) // parallel["workercount"]
        config.args[:] = files[begin:] + files[:begin]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first; parallel workers come to the same order."""
    places = {name: place for place, name in enumerate(LONGEST)}

    def place(path: Path) -> int:
        return min(places.get(name, len(places)) for name in (path.stem, f"{path.parent.name}/{path.stem}"))

    items.sort(key=lambda item: (place(item.path), item.path))


def pytest_collection_finish() -> None:
    gc.enable()
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)  # later collections leave alone what thousands of tests are made of
