"""The shipped table and bag are found by name, and were made with this version."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest
from click.testing import CliRunner

from ember_ros.bag.reader import Bag
from ember_ros.cli import main
from ember_ros.errors import BagError, TableError
from ember_ros.params import Params
from ember_ros.shipped import BAG, DATA, TABLE
from leg_node.table_file import describe_differences, load_table

MAX_BYTES = 300_000

needs_sim = pytest.mark.skipif(find_spec("pybullet") is None, reason="pybullet is missing")
needs_bags = pytest.mark.skipif(find_spec("rosbags") is None, reason="rosbags is missing")


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Change into an empty folder."""
    monkeypatch.chdir(tmp_path)


def test_shipped_table_has_the_default_parameters() -> None:
    """It was learnt with the present defaults; the README.md beside it has the command."""
    table, about = load_table(Path(TABLE), Params())
    assert describe_differences(Path(TABLE), about, Params()) is None
    assert about["cycle"] == 6000
    assert table.visits.sum() > 0
    assert (DATA / f"{TABLE}.npz").stat().st_size < MAX_BYTES


@needs_bags
def test_shipped_bag_starts_from_the_shipped_table() -> None:
    """The two commands of that README.md made both."""
    with Bag(Path(BAG)) as bag:
        assert bag.table is not None
        assert bag.table.sha256() == load_table(Path(TABLE), Params())[0].sha256()
        assert bag.params == Params()


def test_a_file_in_the_working_folder_has_precedence() -> None:
    """A file or folder of that name in the working folder is used, even if it is invalid."""
    Path(TABLE).write_text("mine\n")
    with pytest.raises(TableError, match=r"^trained is not a whole ember_ros table"):
        load_table(Path(TABLE), Params())
    Path(BAG).mkdir()
    with pytest.raises(BagError, match=r"^walk is no bag"):
        Bag(Path(BAG))


def test_a_folder_of_that_name_does_not_hide_the_shipped_table() -> None:
    """``ember walk --table trained --out trained`` makes the folder before it reads the table."""
    Path(TABLE).mkdir()
    assert len(load_table(Path(TABLE), Params())[0])


@needs_sim
def test_a_run_starts_from_the_shipped_table() -> None:
    """A walk works without a training before it."""
    words = ["walk", "--table", TABLE, "--on", "loop", "--cycles", "2", "--out", TABLE]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    table, about = load_table(Path(TABLE) / "table.npz", Params())
    assert about["cycle"] == 2
    # Two cycles add few visits to those of the table.
    assert table.visits.sum() > load_table(Path(TABLE), Params())[0].visits.sum()


@needs_bags
def test_the_shipped_bag_is_replayed() -> None:
    """A replay works without a recording before it."""
    result = CliRunner().invoke(main, ["replay", BAG])
    assert result.exit_code == 0, result.output
    assert "equal to the recorded one" in result.output
