"""pip reads pyproject.toml, colcon reads setup.py and package.xml: all three must say the same."""

from __future__ import annotations

import ast
import os
import re
import runpy
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import setuptools
import yaml

import ember_ros
from ember_ros import entry_points
from ember_ros.entry_points import NODES
from support.command import ROOT, started
from support.waiting import DEADLINE_S

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

LAUNCH = ROOT / "ember_ros" / "launch"
CONFIG = ROOT / "ember_ros" / "config"
WRAPPERS = ROOT / "ember_ros" / "resource" / "lib"

# Names under which rosdep knows what pip and Python call otherwise.
ROSDEP = {
    "PyYAML": "python3-yaml",
    "click": "python3-click",
    "matplotlib": "python3-matplotlib",
    "numpy": "python3-numpy",
    "pybullet": "python3-pybullet-pip",
    "pybullet_data": "python3-pybullet-pip",
    "rich": "python3-rich",
    "scipy": "python3-scipy",
    "yaml": "python3-yaml",
}
# Imported only by what says how to install them: the extra `bags`, in which mcap brings lz4 and
# zstandard, and the extras `notebook` and `envs`.
OPTIONAL = {"gymnasium", "lz4", "mcap", "pandas", "pettingzoo", "rosbags", "zstandard"}


@pytest.fixture
def pyproject() -> dict[str, Any]:
    """What pip is told."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture
def setup_py(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What colcon is told: the arguments that setup.py calls setup() with."""
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr(setuptools, "setup", lambda **arguments: calls.append(arguments))
    monkeypatch.chdir(ROOT)
    runpy.run_path("setup.py", run_name="__main__")
    (arguments,) = calls
    return arguments


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """What pip builds: the wheel and the sdist of this folder, and the wheel of that sdist."""
    pytest.importorskip("hatchling", reason="hatchling is not installed")
    folder = tmp_path_factory.mktemp("built")
    build = [sys.executable, "-m", "hatchling", "build", "--directory"]
    for kind in ("wheel", "sdist"):
        subprocess.run([*build, folder / kind, "--target", kind], cwd=ROOT, check=True, timeout=60)
    (wheel,), (sdist,) = (folder / "wheel").iterdir(), (folder / "sdist").iterdir()
    with tarfile.open(sdist) as tar:
        tar.extractall(folder, filter="data")
    source = folder / sdist.name.removesuffix(".tar.gz")
    subprocess.run([*build, folder / "again", "--target", "wheel"], cwd=source, check=True)
    (again,) = (folder / "again").iterdir()
    return {"wheel": wheel, "sdist": sdist, "again": again}


@pytest.fixture
def package_xml() -> ElementTree.Element:
    """What rosdep and the ROS release tools are told."""
    return ElementTree.parse(ROOT / "package.xml").getroot()


def text(element: ElementTree.Element, tag: str) -> str:
    """Return the text of the only child with this tag."""
    (child,) = element.findall(tag)
    assert child.text
    return child.text.strip()


def top_packages(pyproject: dict[str, Any]) -> list[str]:
    """Return the names of the top-level packages in the wheel."""
    names: list[str] = pyproject["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    return names


def shipped_by_pip(pyproject: dict[str, Any]) -> dict[str, str]:
    """Return {place below the prefix: source} of the wheel's shared data, folders walked."""
    wheel = pyproject["tool"]["hatch"]["build"]["targets"]["wheel"]
    shipped = {}
    for source, place in wheel["shared-data"].items():
        path = ROOT / source
        assert path.exists(), f"pyproject.toml ships {source}, which does not exist"
        for file in [path] if path.is_file() else files_below(path):
            below = "" if file == path else f"/{file.relative_to(path).as_posix()}"
            shipped[place + below] = source + below
    return shipped


def shipped_by_colcon(setup_py: dict[str, Any]) -> dict[str, str]:
    """Return {place below the prefix: source} of setup.py's data files."""
    return {
        f"{folder}/{Path(source).name}": source
        for folder, sources in setup_py["data_files"]
        for source in sources
    }


def files_below(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder, without what Python compiled."""
    return (path for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc")


def in_site_packages(pyproject: dict[str, Any]) -> Iterator[Path]:
    """Yield the files of packages that go where Python imports from, in both installations."""
    elsewhere = (LAUNCH, WRAPPERS.parent)
    for name in top_packages(pyproject):
        for path in files_below(ROOT / name):
            if not any(folder in path.parents for folder in elsewhere):
                yield path


def test_names_agree(
    pyproject: dict[str, Any], setup_py: dict[str, Any], package_xml: ElementTree.Element
) -> None:
    """Pip, colcon and ROS know the package under one name, which the ament marker bears too."""
    assert pyproject["project"]["name"] == "ember_ros"
    assert setup_py["name"] == "ember_ros"
    assert text(package_xml, "name") == "ember_ros"
    assert (ROOT / "ember_ros" / "resource" / "ember_ros").read_bytes() == b""


def test_versions_agree(
    pyproject: dict[str, Any], setup_py: dict[str, Any], package_xml: ElementTree.Element
) -> None:
    """A release that bumps the version in one place and forgets another fails."""
    source = pyproject["tool"]["hatch"]["version"]
    found = re.findall(source["pattern"], (ROOT / source["path"]).read_text())
    assert found == [text(package_xml, "version")]
    assert setup_py["version"] == text(package_xml, "version")
    # Read from the installation, so that an outdated one fails; a bare checkout has none.
    assert ember_ros.__version__ in (text(package_xml, "version"), "unknown")


def test_release_tools_can_bump_setup_py() -> None:
    """catkin_prepare_release, which looks for exactly this, finds one literal version."""
    literals = re.findall(r'version="\d+\.\d+\.\d+",', (ROOT / "setup.py").read_text())
    assert len(literals) == 1


def test_ember_is_the_only_console_script(
    pyproject: dict[str, Any], setup_py: dict[str, Any]
) -> None:
    """Both ways of installing put `ember` into a PATH, and no name that is not ours alone."""
    scripts = pyproject["project"]["scripts"]
    told = [re.split(r"\s*=\s*", line) for line in setup_py["entry_points"]["console_scripts"]]
    assert dict(told) == scripts == {"ember": "ember_ros.entry_points:ember"}
    assert callable(entry_points.ember)


@pytest.mark.parametrize("node", NODES)
def test_node_has_a_main(node: str) -> None:
    """The module of a node exists and has a ``main``, told without importing it."""
    source = ROOT.joinpath(*NODES[node].split(".")).with_suffix(".py")
    names = {getattr(each, "name", None) for each in ast.parse(source.read_text()).body}
    assert "main" in names


def test_packages_agree(pyproject: dict[str, Any], setup_py: dict[str, Any]) -> None:
    """Every module that pip installs lies in a package that colcon installs, and no other does."""
    folders = {path.parent for path in in_site_packages(pyproject) if path.suffix == ".py"}
    dotted = {".".join(folder.relative_to(ROOT).parts) for folder in folders}
    assert set(setup_py["packages"]) == dotted | {"ember_ros.data"}


def test_the_folder_of_the_bag_is_shipped_beside_the_modules(
    pyproject: dict[str, Any], setup_py: dict[str, Any]
) -> None:
    """Both ways of installing put all of ``bags/`` where ``ember_ros.shipped`` looks first."""
    wheel = pyproject["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["force-include"] == {"bags": "ember_ros/data"}
    assert setup_py["package_dir"] == {"ember_ros.data": "bags"}
    named = setup_py["package_data"]["ember_ros.data"]
    files = [path.relative_to(ROOT / "bags") for path in files_below(ROOT / "bags")]
    assert {Path("README.md"), Path("trained.npz"), Path("walk/metadata.yaml")} <= set(files)
    assert [str(file) for file in files if not any(map(file.match, named))] == []


def test_package_data_agree(pyproject: dict[str, Any], setup_py: dict[str, Any]) -> None:
    """A file beside the modules, which pip installs unasked, is named to colcon, which does not."""
    patterns = [
        f"{package}/{pattern}"
        for package, named in setup_py["package_data"].items()
        for pattern in named
    ]
    assert [
        str(path.relative_to(ROOT))
        for path in in_site_packages(pyproject)
        if path.suffix != ".py"
        and not any(fnmatch(str(path.relative_to(ROOT)), pattern) for pattern in patterns)
    ] == []


def test_data_files_agree(pyproject: dict[str, Any], setup_py: dict[str, Any]) -> None:
    """Both ways of installing put the same files into share/ and lib/."""
    assert shipped_by_pip(pyproject) == shipped_by_colcon(setup_py)


def test_ros_finds_the_package(setup_py: dict[str, Any]) -> None:
    """Marker, manifest, launch and parameter files and a wrapper a node are where ROS looks."""
    launch_files = [path.name for path in files_below(LAUNCH)]
    assert {"walk.launch.py", "train.launch.py"} <= set(launch_files)
    assert set(shipped_by_colcon(setup_py)) == {
        "share/ament_index/resource_index/packages/ember_ros",
        "share/ember_ros/package.xml",
        *(f"share/ember_ros/launch/{name}" for name in launch_files),
        *(f"share/ember_ros/config/{path.name}" for path in files_below(CONFIG)),
        *(f"lib/ember_ros/{node}" for node in NODES),
    }


@pytest.mark.parametrize("node", NODES)
def test_wrapper_is_executable(node: str) -> None:
    """`ros2 run` lists only files that may be executed; git and both installers keep that bit."""
    assert os.access(WRAPPERS / node, os.X_OK)


@pytest.mark.parametrize("linked", [False, True], ids=["copied", "linked"])
@pytest.mark.parametrize("node", NODES)
def test_wrapper_runs_ember_of_its_prefix(node: str, linked: bool, tmp_path: Path) -> None:
    """Copied (pip, colcon) or linked (colcon --symlink-install), from a path with a space.

    The wrapper becomes `ember`, in the same process, so that a signal reaches the node; every
    argument arrives unsplit.
    """
    prefix = tmp_path / "a prefix"
    wrapper = prefix / "lib" / "ember_ros" / node
    wrapper.parent.mkdir(parents=True)
    if linked:
        wrapper.symlink_to(WRAPPERS / node)
    else:
        wrapper.write_bytes((WRAPPERS / node).read_bytes())
        wrapper.chmod(0o755)
    script = prefix / "bin" / "ember"
    script.parent.mkdir()
    script.write_text('#!/bin/sh\necho "$$"\nprintf "%s\\n" "$@"\n')
    script.chmod(0o755)
    command = [wrapper, "--ros-args", "-p", "out:=two words"]
    with started(command, stdout=subprocess.PIPE, text=True) as process:
        output, _ = process.communicate(timeout=DEADLINE_S)
    args = ["node", node, "--ros-args", "-p", "out:=two words"]
    assert output.splitlines() == [str(process.pid), *args]
    assert process.returncode == 0


def test_build_type(package_xml: ElementTree.Element) -> None:
    """Colcon builds the package with setup.py; a setup.cfg would move the console script."""
    (export,) = package_xml.findall("export")
    assert text(export, "build_type") == "ament_python"
    assert package_xml.get("format") == "3"
    assert not (ROOT / "setup.cfg").exists()


def test_pip_dependencies_are_known_to_rosdep(
    pyproject: dict[str, Any], package_xml: ElementTree.Element
) -> None:
    """What pip installs for the package, rosdep installs as well."""
    names = {re.split(r"[^\w-]", line)[0] for line in pyproject["project"]["dependencies"]}
    told = {element.text for element in package_xml.findall("exec_depend")}
    assert {ROSDEP[name] for name in names} <= told


def test_imports_are_declared(pyproject: dict[str, Any], package_xml: ElementTree.Element) -> None:
    """Every package that the source or a launch file imports is an exec_depend in package.xml."""
    imported: set[str] = set()
    for path in [*in_site_packages(pyproject), *files_below(LAUNCH)]:
        if path.suffix != ".py":
            continue
        for node in ast.walk(ast.parse(path.read_text(), str(path))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imported.add(node.module.partition(".")[0])
    foreign = imported - sys.stdlib_module_names - set(top_packages(pyproject)) - OPTIONAL
    told = {element.text for element in package_xml.findall("exec_depend")}
    assert sorted({ROSDEP.get(name, name) for name in foreign} - told) == []


@pytest.mark.slow
def test_the_wheel_has_what_python_and_ros_look_for(
    built: dict[str, Path], pyproject: dict[str, Any], package_xml: ElementTree.Element
) -> None:
    """Modules, types, parameters, table and bag; share/ and lib/ with its executables; licence."""
    named = f"ember_ros-{text(package_xml, 'version')}"
    with zipfile.ZipFile(built["wheel"]) as wheel:
        found = {info.filename: info.external_attr >> 16 for info in wheel.infolist()}
        told = wheel.read(f"{named}.dist-info/METADATA").decode()
    prefix, own = f"{named}.data/data/", f"{named}.dist-info/"
    modules = {path.relative_to(ROOT).as_posix() for path in in_site_packages(pyproject)}
    bags = ROOT / "bags"
    modules |= {f"ember_ros/data/{each.relative_to(bags)}" for each in files_below(bags)}
    assert {name for name in found if not name.startswith((prefix, own))} == modules
    assert {f"{name}/py.typed" for name in top_packages(pyproject)} <= modules
    assert {"ember_ros/data/trained.npz", "ember_ros/data/walk/metadata.yaml"} <= modules
    assert {name.removeprefix(prefix) for name in found if name.startswith(prefix)} == set(
        shipped_by_pip(pyproject)
    )
    assert all(found[f"{prefix}lib/ember_ros/{node}"] & 0o111 == 0o111 for node in NODES)
    assert f"{own}licenses/LICENSE" in found
    assert "Classifier: License :: OSI Approved :: Apache Software License" in told


def test_the_sdist_builds_the_same_wheel(built: dict[str, Path]) -> None:
    """Byte for byte: whoever packages from the sdist gives users what a checkout gives."""
    assert built["again"].name == built["wheel"].name
    assert built["again"].read_bytes() == built["wheel"].read_bytes()


def test_the_sdist_can_be_tested(built: dict[str, Path]) -> None:
    """Tests, documents and what colcon reads come along; nothing that was made by running does."""
    with tarfile.open(built["sdist"]) as tar:
        found = {name.partition("/")[2] for name in tar.getnames()}
    wanted = ("LICENSE", "README.md", "CHANGELOG.rst", "CITATION.cff", "package.xml", "setup.py")
    assert {*wanted, "docs/GRAPH.md", "test/conftest.py"} <= found
    assert not [name for name in found if name.startswith((".venv", "out/", ".hypothesis"))]


def test_versions_in_the_citation_agree(package_xml: ElementTree.Element) -> None:
    """Whoever cites the software names the version that is here."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == text(package_xml, "version")
    assert citation["license"] == text(package_xml, "license")
    assert f"version = {{{citation['version']}}}" in (ROOT / "README.md").read_text("utf-8")


def test_installed_prefix_is_complete(pyproject: dict[str, Any]) -> None:
    """The environment the tests run in, if one was named, holds what `ros2 run` looks for.

    `make test` names .venv, so this proves that an editable install brings the marker, an
    executable file for each node, and the `ember` that each of them runs.
    """
    prefixes = [Path(part) for part in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if part]
    marker = "share/ament_index/resource_index/packages/ember_ros"
    prefix = next((path for path in prefixes if (path / marker).is_file()), None)
    if prefix is None:
        pytest.skip("AMENT_PREFIX_PATH names no prefix that ember_ros is installed in")
    for place in shipped_by_pip(pyproject):
        assert (prefix / place).is_file()
    for node in NODES:
        assert os.access(prefix / "lib" / "ember_ros" / node, os.X_OK)
    assert os.access(prefix / "bin" / "ember", os.X_OK)
    assert not [node for node in NODES if (prefix / "bin" / node).exists()]
