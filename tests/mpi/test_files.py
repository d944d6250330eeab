"""Files of `tests/parallel`, each on 2 and on 3 ranks, with a time limit: ranks that wait for each other fail."""

from pathlib import Path

import pytest
from launch import ROOT, TIME_LIMIT, run_on_ranks

FILES = sorted((ROOT / "tests/parallel").glob("test_*.py"))


@pytest.mark.parametrize("size", [2, 3])
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem.removeprefix("test_"))
def test_file_passes_on_several_ranks(file: Path, size: int) -> None:
    dump_after = str(TIME_LIMIT - 10)  # where each rank is, before it is too late
    options = ["-q", "-x", "-p", "no:cacheprovider"]
    code, output = run_on_ranks(size, "-m", "pytest", *options, str(file), THCCS_DUMP_AFTER=dump_after)
    if code:
        pytest.fail(f"{file.name} failed on {size} ranks:\n{output}", pytrace=False)
