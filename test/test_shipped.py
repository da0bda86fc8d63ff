"""The table and the walk that come with the package are found by name, and are of this version."""

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
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand in a folder in which there is nothing of the package."""
    monkeypatch.chdir(tmp_path)


def test_the_table_is_of_this_version() -> None:
    """It was learnt with all of today's parameters; the README beside it says how it is made."""
    table, about = load_table(Path(TABLE), Params())
    assert describe_differences(Path(TABLE), about, Params()) is None
    assert about["cycle"] == 6000
    assert table.visits.sum() > 0
    assert (DATA / f"{TABLE}.npz").stat().st_size < MAX_BYTES


@needs_bags
def test_the_walk_begins_with_the_table() -> None:
    """Both were made by the two commands of the README, one after the other."""
    with Bag(Path(BAG)) as bag:
        assert bag.table is not None
        assert bag.table.sha256() == load_table(Path(TABLE), Params())[0].sha256()
        assert bag.params == Params()


def test_what_lies_here_comes_first() -> None:
    """A user's own file or folder of that name is what is meant, even if it is of no use."""
    Path(TABLE).write_text("mine\n")
    with pytest.raises(TableError, match=r"^trained is not a whole ember_ros table"):
        load_table(Path(TABLE), Params())
    Path(BAG).mkdir()
    with pytest.raises(BagError, match=r"^walk is no bag"):
        Bag(Path(BAG))


def test_a_folder_is_no_table_of_that_name() -> None:
    """``ember walk --table trained --out trained`` makes the folder before it reads the table."""
    Path(TABLE).mkdir()
    assert len(load_table(Path(TABLE), Params())[0])


@needs_sim
def test_a_walk_starts_from_the_table() -> None:
    """Nobody has to train before anything walks."""
    words = ["walk", "--table", TABLE, "--on", "loop", "--cycles", "2", "--out", TABLE]
    told = CliRunner().invoke(main, words)
    assert told.exit_code == 0, told.output
    table, about = load_table(Path(TABLE) / "table.npz", Params())
    assert about["cycle"] == 2
    # What a leg learns in two cycles is little beside what it knew.
    assert table.visits.sum() > load_table(Path(TABLE), Params())[0].visits.sum()


@needs_bags
def test_the_walk_is_replayed() -> None:
    """The first thing that may be tried on a bag works without one's own."""
    told = CliRunner().invoke(main, ["replay", BAG])
    assert told.exit_code == 0, told.output
    assert "equal to the recorded one" in told.output
