"""What pip installs: the three packages, their data, and one set of forms under one name."""

import importlib.metadata
import tomllib
from pathlib import Path

import pytest

import thccs_fem
import thccs_fem.forms

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUPTOOLS = PROJECT["tool"]["setuptools"]


def test_forms_are_the_folder_at_the_top() -> None:
    assert SETUPTOOLS["package-dir"] == {"thccs_fem.forms": "forms"}
    assert (ROOT / "thccs_fem/forms").is_symlink()
    assert (ROOT / "thccs_fem/forms").readlink() == Path("../forms")
    assert Path(thccs_fem.forms.__file__).samefile(ROOT / "forms/__init__.py")


def test_no_package_is_forgotten() -> None:
    inits = {*(ROOT / "thccs_fem").rglob("__init__.py"), ROOT / "thccs_fem/forms/__init__.py"}
    packages = [".".join(path.relative_to(ROOT).parent.parts) for path in inits]
    assert sorted(packages) == sorted(SETUPTOOLS["packages"])


def test_no_data_file_is_forgotten() -> None:
    [(package, patterns)] = SETUPTOOLS["package-data"].items()
    shipped = {path for pattern in patterns for path in (ROOT / package).glob(pattern)}
    files = {path for path in (ROOT / "thccs_fem").rglob("*") if path.is_file()}
    data = {path for path in files if path.suffix not in {".py", ".pyc"}}
    assert data == shipped
    assert ROOT / "thccs_fem/py.typed" in data


def test_version_is_the_installed_one() -> None:
    try:
        installed = importlib.metadata.version("thccs-fem")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("runs from the checkout without having been installed")
    assert thccs_fem.__version__ == installed


def test_python_of_the_checkout_will_do() -> None:
    chosen = (ROOT / ".python-version").read_text().strip()
    assert PROJECT["project"]["requires-python"] == f">={chosen}"
