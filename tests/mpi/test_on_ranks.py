"""The tests of `tests/parallel`, on 2 and on 3 ranks."""

import pytest
from launch import run_on_ranks


@pytest.mark.parametrize("size", [2, 3])
def test_parallel_tests_pass_on_several_ranks(size: int) -> None:
    # Each test has a time limit, see its conftest.py; this one is for all that is around them.
    options = ["-q", "-p", "no:cacheprovider", "--durations=10"]
    code, output = run_on_ranks(size, "-m", "pytest", *options, "tests/parallel", time_limit=1200)
    if code:
        pytest.fail(f"tests/parallel fails on {size} ranks:\n{output}", pytrace=False)
