"""What a person types who has a bag: looking, replaying, learning again, recording."""

from __future__ import annotations

import csv
import gc
import json
import math
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner

from ember_ros import wire
from ember_ros.bag import inspection
from ember_ros.bag.reader import Bag, Raw
from ember_ros.bag.storage import INFORMATION, METADATA, BagOptions, McapWriter, seal
from ember_ros.cli import main
from ember_ros.params import Params, as_dict, params_sha256, replace
from ember_ros.params_file import dump_params, load_params
from ember_ros.report.run_statistics import BODY, Row
from ember_ros.run import SUMMARY, TABLE
from ember_ros.run_config import RunConfig
from leg_node.assembly import empty_table
from leg_node.reward import PaperReward
from leg_node.table_file import load_table, save_table
from support import bags
from support.bags import RecordedRun, write
from support.configs import TINY as PARAMS
from support.legs import LEGS
from support.needs import needs_bags, needs_bullet

pytestmark = needs_bags

TICKS, TICK_NS = PARAMS.gait.ticks, PARAMS.gait.tick_ns
CYCLES = 2

Go = Callable[..., str]
Change = Callable[[Raw], Raw | None]


# -- typing --------------------------------------------------------------------------------------


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Go:
    """Return a runner of commands in a folder of its own; it returns all that was printed.

    The exit code must be the one that is given, or any but 0 for None.
    """
    monkeypatch.chdir(tmp_path)

    def go(*words: Any, code: int | None = 0) -> str:
        typed = [str(word) for word in words]
        monkeypatch.setattr(sys, "argv", ["ember", *typed])
        result = CliRunner().invoke(main, typed, prog_name="ember")
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert result.exit_code == code or (code is None and result.exit_code), result.output
        return result.output

    return go


def mistake(run: Go, *words: Any) -> str:
    """Type what is a mistake; return the one line that says so."""
    said = run(*words, code=2)
    assert said.startswith("error: ")
    assert len(said.splitlines()) == 1, said
    return said


def words_of(text: str) -> str:
    """Return a text with all its white space made one space."""
    return " ".join(text.split())


# -- bags ----------------------------------------------------------------------------------------


def record(
    bag: Path,
    *,
    cycles: int = CYCLES,
    seed: int = 3,
    world: str = "walker",
    table: Path | None = None,
    **how: Any,
) -> RecordedRun:
    """Record a run of the fake world, in which the robot falls twice."""
    config = RunConfig(world, cycles, seed=seed, params=PARAMS, table=table)
    return bags.record(bag, config, falls_at=[20, 50], about={"ember_ros": "1.2.3"}, **how)


def rewritten(made: RecordedRun, bag: Path, change: Change) -> Path:
    """Write a bag anew, some of its messages changed or (None) left out, sealed as before."""
    changed = map(change, bags.raws_of(made.bag))
    return write(bag, (raw for raw in changed if raw is not None), made.table)


def slower(leg: str, tick: int) -> Change:
    """Change the hip speed in a command by its least bit."""
    commands = wire.CommandWire(leg, TICK_NS)

    def change(raw: Raw) -> Raw:
        if (raw.topic, raw.ns) != (f"/{leg}/command", tick * TICK_NS):
            return raw
        said = commands.read(raw.data)
        other = math.nextafter(said.hip_speed, math.inf)
        return raw._replace(data=commands.pack(said._replace(hip_speed=other)))

    return change


def slid(leg: str, tick: int) -> Change:
    """Change the slip in a leg's senses by its least bit."""
    contact = wire.JointWire(f"{leg}_foot", wire.CONTACT, "position", "effort")

    def change(raw: Raw) -> Raw:
        if (raw.topic, raw.ns) != (f"/{leg}/contact", tick * TICK_NS):
            return raw
        ns, (slip, *rest), effort = contact.read(raw.data, "")
        return raw._replace(data=contact.pack(ns, (math.nextafter(slip, math.inf), *rest), effort))

    return change


def without(*topics: str, since: int = 0, until: int = 10**6) -> Change:
    """Leave out messages of some ticks: of these topics, or all for none."""

    def change(raw: Raw) -> Raw | None:
        of_tick = not raw.topic.startswith("/run/") or raw.topic in topics
        at = raw.ns // TICK_NS
        gone = of_tick and since <= at < until and (not topics or raw.topic in topics)
        return None if gone else raw

    return change


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    """Record a walk once for all tests that only look at it."""
    return record(tmp_path_factory.mktemp("walked") / "walk")


@pytest.fixture(scope="module")
def others(walked: RecordedRun) -> Path:
    """Return a bag of another recorder: nobody knows what determined it."""
    return rewritten(
        walked,
        walked.bag.with_name("others"),
        without("/run/card", "/run/values", "/run/visits", "/run/crc"),
    )


@pytest.fixture(scope="module")
def damaged(walked: RecordedRun) -> Path:
    """Return a bag in which one leg's senses were changed at one tick."""
    return rewritten(walked, walked.bag.with_name("damaged"), slid("rear_left", 40))


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> dict[str, RecordedRun]:
    """Record two robots into one bag."""
    bag = tmp_path_factory.mktemp("two") / "two"
    writer = McapWriter(BagOptions(bag))
    made = {
        name: record(bag, cycles=2, namespace=name, seed=seed, writer=writer)
        for seed, name in enumerate(["robot_1", "robot_2"])
    }
    writer.close()
    return made


# -- help, and mistakes ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ("replay", ("--on", "--rate", "--namespace", "--table", "bit for bit", "exit code is 0")),
        ("play", ("--rate", "--start", "--paused", "--live", "--namespace", "play/pause")),
        ("relearn", ("--gamma", "--alpha", "--bins", "--stage", "--passes", "--out", "--force")),
        ("bag", ("info", "csv", "repair")),
        ("bag info", ("--namespace", "--cycles", "--json")),
        ("bag csv", ("--namespace", "--out", "out/csv", "pandas")),
        ("bag repair", ("BAG", "interrupted", "metadata.yaml")),
        ("walk", ("--bag", "--split-s", "--split-mb")),
        ("train", ("--bag", "--split-s", "--split-mb")),
    ],
)
def test_help_tells_what_can_be_asked(run: Go, command: str, reason: Sequence[str]) -> None:
    """Every command that has to do with bags says what it is for and what its options are."""
    text = words_of(run(*command.split(), "--help"))
    for each in (f"Usage: ember {command}", *reason):
        assert each in text
    assert command.split()[0] in run("--help")


def test_every_reward_and_every_edge_is_an_option_of_relearn(run: Go) -> None:
    """By its full name, with its meaning and its unit."""
    text = words_of(run("relearn", "--help"))
    for group in ("reward", "state"):
        for name in as_dict(PARAMS)[group]:
            assert f"--{group}.{name}" in text
    assert "weight of the slip term [1]" in text


COMMANDS = [
    "bag info",
    "bag csv --out o",
    "replay",
    "relearn --out o",
    pytest.param("play", marks=pytest.mark.ros),
]

SPOILT = {
    "nothing": "there is no bag",
    "notes.txt": "is no bag",
    "empty": "is no bag",
    "cut": "ember bag repair",
    "torn": "ember bag repair",
    "no-yaml": "no metadata of a bag",
    "newer": "version 10",
    "chatter": "no robot of ember_ros",
    "topic": "/rear_left/command",
}
"""What is no bag, or none that can be read, by its name; and words that say why."""


@pytest.fixture(scope="module")
def spoilt(walked: RecordedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make what is no bag, in a folder."""
    folder = tmp_path_factory.mktemp("spoilt")
    (folder / "notes.txt").write_text("a text")
    (folder / "empty").mkdir()
    for name in ("cut", "torn", "no-yaml", "newer"):
        shutil.copytree(walked.bag, folder / name)
    (folder / "cut" / METADATA).unlink()
    (torn,) = (folder / "torn").glob("*.mcap")
    torn.write_bytes(torn.read_bytes()[:5000])
    (folder / "no-yaml" / METADATA).write_text("{")
    text = (folder / "newer" / METADATA).read_text()
    (folder / "newer" / METADATA).write_text(text.replace("version: 9", "version: 10"))
    rewritten(
        walked,
        folder / "chatter",
        lambda raw: raw._replace(topic="/chatter") if raw.topic == "/clock" else None,
    )
    rewritten(walked, folder / "topic", without("/rear_left/command"))
    return folder


def hold_said(run: Go, bag: Path, command: str) -> None:
    """Hold that a command says in one line what is wrong with a bag, and leaves nothing."""
    said = mistake(run, *command.split(), bag)
    assert SPOILT[bag.name] in said
    assert str(bag) in said
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize("name", SPOILT)
def test_what_is_no_bag_is_said_in_one_line(run: Go, spoilt: Path, name: str) -> None:
    """Exit code 2, the file, what is wrong, what would be right; no traceback."""
    hold_said(run, spoilt / name, "bag info")


@pytest.mark.parametrize("name", ["nothing", "notes.txt", "cut", "topic"])
@pytest.mark.parametrize("command", COMMANDS[1:])
def test_every_command_says_it_alike(run: Go, spoilt: Path, command: str, name: str) -> None:
    """In the same words, before anything is made."""
    hold_said(run, spoilt / name, command)


@pytest.mark.parametrize("command", COMMANDS)
def test_of_two_robots_one_must_be_chosen(
    run: Go, two: dict[str, RecordedRun], command: str
) -> None:
    """Nothing is guessed: the mistake names both, and the option."""
    bag = two["robot_1"].bag
    said = mistake(run, *command.split(), bag)
    assert "/robot_1, /robot_2" in said
    assert "--namespace" in said


def test_a_robot_that_is_not_there_is_said(run: Go, two: dict[str, RecordedRun]) -> None:
    """With those that are."""
    said = mistake(run, "bag", "info", two["robot_1"].bag, "--namespace", "robot_3")
    assert "robot_3" in said
    assert "/robot_1, /robot_2" in said


# -- info ------------------------------------------------------------------------------------------


def test_info_tells_what_is_inside(run: Go, walked: RecordedRun) -> None:
    """Run, cycles, falls, distance, provenance, and a line a module."""
    text = run("bag", "info", walked.bag)
    lines = dict(re.split(r"\s{2,}", line.strip(), maxsplit=1) for line in text.splitlines()[:13])
    assert lines["bag"] == str(walked.bag)
    assert lines["storage"].startswith("mcap, 1 file, ")
    assert lines["robot"] == "/, walker"
    assert lines["ticks"] == "64 from 0 on: 1 s, 2 cycles"
    assert lines["falls"] == "2"
    assert lines["lost ticks"] == "0"
    assert (
        lines["legs"]
        == "learning True, policy learned, seed 3, shared True, stage walk, start_cycle 0"
    )
    assert lines["versions"] == "ember_ros 1.2.3"
    assert lines["parameters SHA-256"] == params_sha256(PARAMS)[:12]
    assert lines["table SHA-256, start"] == empty_table(PARAMS).sha256()[:12]
    assert lines["table SHA-256, end"] == walked.table[:12]
    with Bag(walked.bag) as opened:
        found, _ = inspection.info(opened)
    assert lines["distance"] == f"{found['distance_m']:.3f} m"
    messages = sum(found["messages"].values())
    assert lines["messages"] == f"{messages} on {len(found['messages'])} topics"
    modules = [line.split()[:2] for line in text.splitlines()[-5:]]
    assert modules == [["2", module] for module in (*LEGS, BODY)]


def test_info_tells_of_every_cycle_when_asked(run: Go, walked: RecordedRun) -> None:
    """A line a cycle and module, with the very numbers."""
    text = run("bag", "info", walked.bag, "--cycles")
    lines = [line.split() for line in text.splitlines()[-CYCLES * 5 :]]
    with Bag(walked.bag) as opened:
        _, rows = inspection.info(opened)
    assert len(rows) == len(lines)
    for row, line in zip(rows, lines, strict=True):
        assert line[:3] == [str(row.cycle), row.module, f"{row.reward:.3f}"]
        assert line[3:6] == [
            f"{row.contact_share:.0%}",
            f"{row.peak_force_n:.0f}",
            f"{row.slip_m:.3f}",
        ]
        assert line[6:] == ([f"{row.distance_m:.3f}", str(row.falls)] if row.module == BODY else [])


def test_info_for_programs(run: Go, walked: RecordedRun) -> None:
    """JSON of all that is found, cycles and all, and nothing else on the output."""
    found = json.loads(run("bag", "info", walked.bag, "--json"))
    rows = [Row(**row) for row in found.pop("rows")]
    with Bag(walked.bag) as opened:
        expected, expected_rows = inspection.info(opened)
    assert found == json.loads(json.dumps(expected))
    assert [repr(row) for row in rows] == [repr(row) for row in expected_rows]


def test_info_tells_what_is_missing(run: Go, walked: RecordedRun) -> None:
    """Gaps, senses and commands that are not there; that is no mistake and no damage."""
    gap = without(since=10, until=13)
    absent = without("/front_left/command", since=50, until=52)

    def change(raw: Raw) -> Raw | None:
        left = gap(raw)
        return None if left is None else absent(left)

    text = words_of(run("bag", "info", rewritten(walked, Path("gap"), change)))
    assert "ticks 61 from 0 on" in text
    assert "lost ticks 3" in text
    assert "gap ticks 10 to 12" in text
    assert "front_left 2 ticks without a command" in text


def test_info_finds_damage(run: Go, damaged: Path) -> None:
    """One bit of one number: exit code 1, tick and leg; for programs as well."""
    text = words_of(run("bag", "info", damaged, code=1))
    assert "damaged tick 40, rear_left: the senses are not the recorded ones" in text
    found = json.loads(run("bag", "info", damaged, "--json", code=1))
    (damage,) = found["damaged"]
    assert (damage["tick"], damage["leg"]) == (40, "rear_left")
    assert damage["found"] != damage["recorded"]


def test_info_of_a_bag_of_others(run: Go, others: Path) -> None:
    """All but the provenance; it is said why that is not there."""
    text = words_of(run("bag", "info", others))
    assert "64 from 0 on: 1 s, 2 cycles" in text
    assert "run not recorded: a bag of another recorder, which cannot be replayed" in text
    assert "card" not in json.loads(run("bag", "info", others, "--json"))


def test_info_of_one_of_two_robots(run: Go, two: dict[str, RecordedRun]) -> None:
    """The one that is asked for."""
    for name, made in two.items():
        found = json.loads(run("bag", "info", made.bag, "--json", "--namespace", name))
        assert (found["namespace"], found["ticks"]) == (f"/{name}", 64)
        assert found["card"]["legs"]["rear_left"]["seed"] == made.config.seed


@pytest.mark.parametrize("name", ["run[bold]x", "run[/x]", "run[link=a]"])
def test_a_folder_may_have_any_name(run: Go, walked: RecordedRun, name: str) -> None:
    """What looks like markup is a name: it is printed as it is."""
    shutil.copytree(walked.bag, name)
    assert name in run("bag", "info", name)
    assert name in run("bag", "csv", name, "--out", f"{name}-csv")


# -- csv -------------------------------------------------------------------------------------------


def test_csv_writes_two_files(run: Go, walked: RecordedRun) -> None:
    """Where it says, a line a tick and leg and a line a cycle and module; never over others."""
    text = words_of(run("bag", "csv", walked.bag))
    assert text == "In out/csv: cycles.csv, ticks.csv"
    with Path("out/csv/ticks.csv").open(newline="") as file:
        lines = list(csv.reader(file))
    assert tuple(lines[0]) == (
        *inspection.TICK_COLUMNS,
        *(f"reward_{n}" for n in PaperReward.names),
    )
    assert len(lines) == 1 + CYCLES * TICKS * 4
    with Path("out/csv/cycles.csv").open(newline="") as file:
        lines = list(csv.reader(file))
    assert tuple(lines[0]) == Row._fields
    assert len(lines) == 1 + CYCLES * 5
    before = Path("out/csv/ticks.csv").read_bytes()
    said = mistake(run, "bag", "csv", walked.bag)
    assert "is there already" in said
    assert "--out" in said
    assert Path("out/csv/ticks.csv").read_bytes() == before
    run("bag", "csv", walked.bag, "--out", "elsewhere")
    assert Path("elsewhere/ticks.csv").read_bytes() == before


def test_csv_of_one_of_two_robots(run: Go, two: dict[str, RecordedRun]) -> None:
    """The one that is asked for: two robots of two seeds did different things."""
    for name, made in two.items():
        run("bag", "csv", made.bag, "--out", name, "--namespace", name)
    one, other = (Path(name, "ticks.csv").read_text() for name in two)
    assert one != other
    assert one.count("\n") == other.count("\n") == 1 + 64 * 4


def test_csv_of_a_damaged_bag_says_so(run: Go, damaged: Path) -> None:
    """Numbers that were changed are not handed on in silence."""
    text = words_of(run("bag", "csv", damaged, "--out", "o", code=1))
    assert "tick 40, rear_left" in text


# -- repair ----------------------------------------------------------------------------------------


def test_repair_brings_back_a_bag_that_was_cut_off(run: Go) -> None:
    """Refused before, whole after: what it says is what there is."""
    made = record(Path("bag"))
    Path("bag", METADATA).unlink()
    assert "ember bag repair bag" in mistake(run, "bag", "info", "bag")
    text = words_of(run("bag", "repair", "bag"))
    assert "ticks 64 (2 cycles)" in text
    assert "damaged chunks 0" in text
    assert "64 from 0 on" in words_of(run("bag", "info", "bag"))
    text = words_of(run("replay", "bag"))
    assert made.table[:12] in text
    assert "Equal, bit for bit." in text


def test_repair_keeps_what_was_finished(run: Go) -> None:
    """Of a torn file the whole chunks; a replay of them ends where they do."""
    record(Path("bag"))
    Path("bag", METADATA).unlink()
    file = Path("bag/bag_0.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    text = run("bag", "repair", "bag")
    lines = dict(re.split(r"\s{2,}", line.strip(), maxsplit=1) for line in text.splitlines())
    ticks = int(lines["ticks"].split()[0])
    assert 0 < ticks < CYCLES * TICKS
    assert ticks % 16 == 0
    assert int(lines["incomplete at the end"].split()[0]) > 0
    found = json.loads(run("bag", "info", "bag", "--json"))
    assert (found["ticks"], found["damaged"], found["lost_ticks"]) == (ticks, [], 0)
    assert "Equal, bit for bit." in run("replay", "bag")


@pytest.mark.parametrize("content", [None, b"", b"no MCAP at all", bytes(100)])
def test_repair_of_nothing_is_a_mistake(run: Go, content: bytes | None) -> None:
    """Nothing whole, or nothing there: said in a line, and what is there is left as it is."""
    said = mistake(run, "bag", "repair", "bag")
    assert "there is no bag bag" in said
    Path("bag").mkdir()
    if content is None:
        assert "is no bag" in mistake(run, "bag", "repair", "bag")
    else:
        Path("bag/bag_0.mcap").write_bytes(content)
        assert "nothing in bag is intact" in mistake(run, "bag", "repair", "bag")
        assert [file.name for file in Path("bag").iterdir()] == ["bag_0.mcap"]
        assert Path("bag/bag_0.mcap").read_bytes() == content


# -- replay ----------------------------------------------------------------------------------------


def test_replay_comes_out_equal(run: Go, walked: RecordedRun) -> None:
    """Exit code 0, how much was held against the record, and the table, which can be kept."""
    text = words_of(run("replay", walked.bag, "--table", "again.npz"))
    assert "ticks 64 (2 cycles)" in text
    assert "commands 256 compared with the record" in text
    assert f"table SHA-256 {walked.table[:12]}, equal to the recorded one" in text
    assert text.endswith("Equal, bit for bit.")
    assert "In again.npz: the table at the end" in text
    assert load_table(Path("again.npz"), PARAMS)[0].sha256() == walked.table
    before = Path("again.npz").read_bytes()
    assert "exists already" in run("replay", walked.bag, "--table", "again.npz", code=2)
    assert Path("again.npz").read_bytes() == before


@pytest.mark.parametrize("world", ["walker", "trainer"])
def test_replay_begins_with_the_table_of_the_run(run: Go, world: str) -> None:
    """A second run that starts from the table of a first, which is gone by then."""
    table = empty_table(PARAMS)
    table.values[:] = [math.sin(n) for n in range(len(table))]
    save_table(Path("start.npz"), table, PARAMS, 0)
    made = record(Path("bag"), world=world, table=Path("start.npz"))
    Path("start.npz").unlink()
    assert f"{made.table[:12]}, equal to the recorded one" in words_of(run("replay", "bag"))


@pytest.mark.parametrize("lost", ["/run/values", "/run/visits"])
def test_replay_needs_the_table_of_the_run(run: Go, lost: str) -> None:
    """Without it nothing is begun: another table would make another run."""
    table = empty_table(PARAMS)
    table.values[:] = [math.sin(n) for n in range(len(table))]
    save_table(Path("start.npz"), table, PARAMS, 0)
    made = record(Path("bag"), table=Path("start.npz"))
    bag = rewritten(made, Path("less"), without(lost))
    assert re.search("table at (its|the) start", mistake(run, "replay", bag))


@pytest.mark.parametrize("tick", [0, 41, 63])
def test_replay_names_the_first_difference(run: Go, walked: RecordedRun, tick: int) -> None:
    """One bit of one command: exit code 1, and tick, leg, field and both values."""
    bag = rewritten(walked, Path("bag"), slower("front_right", tick))
    text = words_of(run("replay", bag, code=1))
    assert f"First difference: tick {tick}, front_right: hip_speed was recorded as" in text
    assert "Equal" not in text


def test_replay_finds_senses_that_were_changed(run: Go, damaged: Path) -> None:
    """One bit of one sense that changes no action: the CRC tells, exit code 1."""
    text = words_of(run("replay", damaged, code=1))
    assert "First difference: tick 40, rear_left: CRC-32 of the senses" in text
    assert "Equal" not in text


@pytest.mark.parametrize("tick", [20, 50])
def test_replay_says_what_differs_beside_the_first(
    run: Go, walked: RecordedRun, damaged: Path, tick: int
) -> None:
    """A command before or after the changed senses: the verdict has both."""
    command = slower("front_left", tick)
    with Bag(damaged) as opened:
        raws = [command(raw) for raw in opened.raw()]
    write(Path("both"), [raw for raw in raws if raw is not None])
    seal(Path("both"), table_sha256=walked.table)
    assert "different: senses, commands" in words_of(run("replay", "both", code=1))


def test_replay_of_a_run_that_is_not_all_there(run: Go, walked: RecordedRun) -> None:
    """It ends where the record does, says why, and is not called equal."""
    text = words_of(
        run("replay", rewritten(walked, Path("gap"), without(since=40, until=41)), code=1)
    )
    assert "ticks 40 (1.25 cycles)" in text
    assert "The record ends early: tick 40 is not in the bag, tick 41 follows." in text
    assert text.endswith("not recorded, or not to its end: table. Equal so far.")
    bag = rewritten(walked, Path("senses"), without("/rear_left/contact", since=9, until=10))
    text = words_of(run("replay", bag, code=1))
    assert "the senses of rear_left at tick 9 are not in the bag" in text


def test_replay_says_what_it_could_not_compare(run: Go, walked: RecordedRun) -> None:
    """A command that nobody recorded is counted; all else came out equal."""
    bag = rewritten(walked, Path("bag"), without("/rear_left/command", since=30, until=33))
    text = words_of(run("replay", bag))
    assert "commands 253 compared with the record" in text
    assert "rear_left 3 ticks without a recorded command" in text
    assert "Equal, bit for bit." in text


def test_replay_holds_the_table_at_the_end_against_the_record(run: Go, walked: RecordedRun) -> None:
    """Another SHA-256 in the metadata: exit code 1; none at all: equal, and it is said."""
    bag = shutil.copytree(walked.bag, "bag")
    seal(Path(bag), table_sha256="f00d" * 16)
    text = words_of(run("replay", "bag", code=1))
    assert f"{walked.table[:12]}, the recorded one is f00df00df00d" in text
    assert "Equal" not in text
    content = yaml.safe_load(Path("bag", METADATA).read_text())
    content[INFORMATION]["custom_data"] = None
    Path("bag", METADATA).write_text(yaml.safe_dump(content))
    text = words_of(run("replay", "bag"))
    assert "not compared: the bag has none" in text
    assert "Equal, bit for bit." in text


def test_replay_of_a_bag_of_others_is_a_mistake(run: Go, others: Path) -> None:
    """It says what can be done with it instead."""
    said = mistake(run, "replay", others)
    for each in ("run/card", "another recorder", "ember bag info", "ember relearn"):
        assert each in said


def test_replay_of_one_of_two_robots(run: Go, two: dict[str, RecordedRun]) -> None:
    """Each with the seed that it had."""
    for name, made in two.items():
        text = words_of(run("replay", made.bag, "--namespace", name))
        assert made.table[:12] in text
        assert "Equal, bit for bit." in text


@pytest.mark.ros
def test_replay_on_the_graph(
    walked: RecordedRun,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Real leg nodes, table node and CPG node: the same bits, the same words."""
    words = ["replay", str(walked.bag), "--on", "graph"]
    main.main(words, prog_name="ember", standalone_mode=False)  # rclpy wants a real stderr
    text = words_of(capfd.readouterr().out)
    assert "commands 256 compared with the record" in text
    assert f"table SHA-256 {walked.table[:12]}, equal to the recorded one" in text
    assert text.endswith("Equal, bit for bit.")


@pytest.mark.parametrize("words", [("--on", "moon"), ("--rate", -1), ("--rate", "nan")])
def test_a_bad_option_of_replay_is_said(run: Go, walked: RecordedRun, words: Sequence[Any]) -> None:
    """Exit code 2 and its value."""
    text = run("replay", walked.bag, *words, code=2)
    assert str(words[1]) in text
    assert "Traceback" not in text


# -- learning again --------------------------------------------------------------------------------


def relearnt(out: Path) -> tuple[dict[str, Any], Params]:
    """Return what a relearn left behind, and hold that it fits together."""
    told = json.loads((out / "relearn.json").read_text())
    params = load_params(out / "params.yaml")
    table, about = load_table(out / TABLE, params)
    assert table.sha256() == told["table_sha256"]
    assert about["relearnt"] == told
    assert int((table.visits > 0).sum()) == told["cells_visited"]
    return told, params


def test_relearn_with_the_same_numbers_learns_the_same(run: Go, walked: RecordedRun) -> None:
    """The table of the run itself, and all that is told of it."""
    text = words_of(run("relearn", walked.bag))
    told, params = relearnt(Path("out/relearn"))
    assert told["table_sha256"] == walked.table
    assert params == PARAMS
    assert told["command"] == shlex.join(["ember", "relearn", str(walked.bag)])
    assert told["bags"] == [str(walked.bag)]
    assert (told["passes"], told["stage"], told["changes"]) == (1, "walk", {})
    assert (told["ticks"], told["falls"], told["skipped"]) == (64, 2, 0)
    assert told["start_table"] is None
    assert f"table SHA-256 {walked.table[:12]}" in text
    assert "ember walk --table out/relearn/table.npz --params out/relearn/params.yaml" in text


@pytest.mark.parametrize(
    ("words", "changes"),
    [
        (("--reward.slip", 2), {"reward.slip": 2.0}),
        (("--state.force_edges", "0.1,0.5"), {"state.force_edges": [0.1, 0.5]}),
        (("--bins", 5), {"state.hip_bins": 5}),
        (("--set", "reward.slip=2.5"), {"reward.slip": 2.5}),
        (("--set", "reward.slip=2.5", "--reward.slip", 3), {"reward.slip": 3.0}),
        (("--alpha", 0.5, "--gamma", 0.25), {"walk.alpha_floor": 0.5, "walk.gamma": 0.25}),
        (
            ("--stage", "train", "--alpha", 0.5, "--gamma", 0),
            {"train.alpha_floor": 0.5, "train.gamma": 0.0},
        ),
        (
            ("--state.hip_bins", 2, "--reward.swing_strike", -0.25, "--gamma", 0.5),
            {"state.hip_bins": 2, "reward.swing_strike": -0.25, "walk.gamma": 0.5},
        ),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_numbers_that_are_given_are_those_that_are_learnt_with(
    run: Go, walked: RecordedRun, words: Sequence[Any], changes: dict[str, Any]
) -> None:
    """They stand in params.yaml and in the table's provenance, and no other number is changed."""
    run("relearn", walked.bag / "walk_0.mcap", *words, "--out", "o")
    told, params = relearnt(Path("o"))
    assert params == replace(PARAMS, changes)
    assert told["changes"] == changes
    assert told["table_sha256"] != walked.table
    assert told["ticks"] == 64


def test_the_stage_decides_which_numbers_hold(run: Go, walked: RecordedRun) -> None:
    """Those of training differ from those of walking, and so does what is learnt."""
    other = replace(PARAMS, {"train.gamma": 0.5})
    Path("p.yaml").write_text(dump_params(other))
    run("relearn", walked.bag, "--stage", "train", "--params", "p.yaml", "--out", "train")
    run("relearn", walked.bag, "--stage", "walk", "--out", "walk")
    train, walk = relearnt(Path("train"))[0], relearnt(Path("walk"))[0]
    assert (train["stage"], walk["stage"]) == ("train", "walk")
    assert walk["table_sha256"] == walked.table != train["table_sha256"]


def test_relearn_goes_on_from_a_table_and_over_many_bags(run: Go, walked: RecordedRun) -> None:
    """Two passes are a pass from the table of the first; bags come one after the other."""
    run("relearn", walked.bag, "--out", "one")
    run("relearn", walked.bag, "--table", f"one/{TABLE}", "--out", "two")
    run("relearn", walked.bag, "--passes", 2, "--out", "passes")
    run("relearn", walked.bag, walked.bag, "--out", "bags")
    two, passes, bags = (relearnt(Path(name))[0] for name in ("two", "passes", "bags"))
    assert two["table_sha256"] == passes["table_sha256"] == bags["table_sha256"]
    assert two["table_sha256"] != walked.table
    assert two["start_table"] == f"one/{TABLE}"
    assert (passes["passes"], passes["ticks"], passes["falls"]) == (2, 128, 4)
    assert bags["bags"] == [str(walked.bag)] * 2


def test_relearn_does_not_replace_unasked(run: Go, walked: RecordedRun) -> None:
    """What an earlier one left stays, unless --force is given."""
    run("relearn", walked.bag, "--out", "o")
    before = {file.name: file.read_bytes() for file in Path("o").iterdir()}
    said = mistake(run, "relearn", walked.bag, "--out", "o", "--gamma", 0.5)
    assert "o has table.npz, params.yaml, relearn.json already" in said
    assert "--force" in said
    assert {file.name: file.read_bytes() for file in Path("o").iterdir()} == before
    run("relearn", walked.bag, "--out", "o", "--gamma", 0.5, "--force")
    assert relearnt(Path("o"))[1].walk.gamma == 0.5
    Path("mine").mkdir()
    Path("mine/params.yaml").write_text("mine")
    assert "mine has params.yaml already" in mistake(run, "relearn", walked.bag, "--out", "mine")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"gait.period": 1.0}, "gait.period"),
        ({"gait.hip_front": 0.6}, "gait.hip_front"),
        ({"leg.knee_speeds": [-1.0, 0.0, 1.0]}, "leg.knee_speeds"),
    ],
)
def test_what_was_done_cannot_be_changed(
    run: Go, walked: RecordedRun, changes: dict[str, Any], reason: str
) -> None:
    """Gait and leg are those of the record; what may be changed is said."""
    Path("mine.yaml").write_text(dump_params(replace(PARAMS, changes)))
    said = mistake(run, "relearn", walked.bag, "--params", "mine.yaml", "--out", "o")
    for each in (str(walked.bag), reason, "reward.*, state.*, train.* and walk.*"):
        assert each in said
    assert not Path("o").exists()


def test_all_numbers_can_be_given_in_a_file(run: Go, walked: RecordedRun) -> None:
    """Options are on top of it."""
    Path("mine.yaml").write_text(
        dump_params(replace(PARAMS, {"reward.slip": 3, "walk.gamma": 0.3}))
    )
    run("relearn", walked.bag, "--params", "mine.yaml", "--gamma", 0.6, "--out", "o")
    told, params = relearnt(Path("o"))
    assert params == replace(PARAMS, {"reward.slip": 3, "walk.gamma": 0.6})
    assert told["changes"] == {"walk.gamma": 0.6}


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--gamma", 1.5), "walk.gamma = 1.5 is out of range"),
        (("--bins", 0), "state.hip_bins = 0 is out of range"),
        (("--state.force_edges", "0.5,0.1"), "must rise strictly"),
        (("--reward.slip", "nan"), "reward.slip = nan"),
        (("--table", "none.npz"), "there is no table none.npz"),
        (("--params", "none.yaml"), "none.yaml"),
    ],
)
def test_a_bad_number_is_said_in_one_line(
    run: Go, walked: RecordedRun, words: Sequence[Any], reason: str
) -> None:
    """Its name, its value, what would be right; nothing is half made."""
    assert reason in mistake(run, "relearn", walked.bag, *words, "--out", "o")
    assert not Path("o").exists()


@pytest.mark.parametrize("words", [("--bins", 5), ("--bins", 2)])
def test_a_table_of_other_cells_cannot_be_gone_on_from(
    run: Go, walked: RecordedRun, words: Sequence[Any]
) -> None:
    """A start table whose cells mean something else than is asked for is refused."""
    run("relearn", walked.bag, "--out", "one")
    said = mistake(run, "relearn", walked.bag, "--table", f"one/{TABLE}", *words, "--out", "o")
    assert f"one/{TABLE}" in said
    assert not Path("o").exists()


@pytest.mark.parametrize(
    "words",
    [("--state.force_edges", "a,b"), ("--bins", "many"), ("--stage", "run"), ("--passes", 0)],
)
def test_a_bad_option_of_relearn_is_said(
    run: Go, walked: RecordedRun, words: Sequence[Any]
) -> None:
    """Exit code 2, the option and its value."""
    text = run("relearn", walked.bag, *words, code=2)
    assert words[0] in text
    assert str(words[1]) in text
    assert "Traceback" not in text
    assert run("relearn", code=2).count("BAGS") >= 1


def test_relearn_from_a_bag_of_others(run: Go, walked: RecordedRun, others: Path) -> None:
    """Numbers are the defaults, or those that are given: then the table of the run comes out."""
    Path("mine.yaml").write_text(dump_params(PARAMS))
    run("relearn", others, "--params", "mine.yaml", "--out", "o")
    told, params = relearnt(Path("o"))
    assert told["table_sha256"] == walked.table
    assert params == PARAMS
    run("relearn", others, "--out", "defaults")
    assert relearnt(Path("defaults"))[1] == Params()


def test_relearn_from_a_damaged_bag_says_so(run: Go, damaged: Path) -> None:
    """Nothing is learnt in silence from what nobody sensed."""
    text = words_of(run("relearn", damaged, "--out", "o", code=None))
    assert "tick 40, rear_left" in text


def test_relearn_from_one_of_two_robots(run: Go, two: dict[str, RecordedRun]) -> None:
    """From what that one did."""
    made = two["robot_2"]
    run("relearn", made.bag, "--namespace", "robot_2", "--out", "o")
    assert relearnt(Path("o"))[0]["table_sha256"] == made.table


# -- recording -------------------------------------------------------------------------------------


@needs_bullet
@pytest.mark.parametrize("verb", ["train", "walk"])
@pytest.mark.slow
def test_a_run_is_recorded_and_replayed(run: Go, verb: str) -> None:
    """In the real worlds: files, provenance and bits are those of the run."""
    where = ("--on", "loop", "--out", "o", "--bag", "deep/bag")
    text = words_of(run(verb, "--cycles", 3, "--seed", 4, "--split-s", 0.5, *where))
    assert "In deep/bag: the whole run; `ember replay deep/bag` repeats it" in text
    files = sorted(file.name for file in Path("deep/bag").iterdir())
    assert files[:-1] == [f"bag_{n}.mcap" for n in range(len(files) - 1)]
    assert files[-1] == METADATA
    assert len(files) > 2
    summary = json.loads(Path("o", SUMMARY).read_text())
    found = json.loads(run("bag", "info", "deep/bag", "--json"))
    assert (found["cycles"], found["falls"]) == (3, summary["falls"])
    assert found["table_sha256"] == summary["table_sha256"]
    assert found["card"]["params_sha256"] == summary["params_sha256"]
    assert found["card"]["versions"] == summary["versions"]
    assert {leg["seed"] for leg in found["card"]["legs"].values()} == {4}
    assert "Equal, bit for bit." in run("replay", "deep/bag")
    run("relearn", "deep/bag", "--out", "again")
    assert relearnt(Path("again"))[0]["table_sha256"] == summary["table_sha256"]


@needs_bullet
def test_a_run_of_no_cycles_has_a_bag(run: Go) -> None:
    """Nothing is in it, and it can be looked into all the same."""
    run("walk", "--cycles", 0, "--on", "loop", "--out", "o", "--bag", "bag")
    text = words_of(run("bag", "info", "bag"))
    assert "ticks 0" in text


@pytest.mark.parametrize("verb", ["train", "walk"])
@pytest.mark.parametrize("there", ["a folder", "a file", "a bag"])
def test_a_bag_is_never_written_over(run: Go, walked: RecordedRun, verb: str, there: str) -> None:
    """An existing folder is refused before anything else is touched, --force or not."""
    bag = Path("bag")
    if there == "a folder":
        bag.mkdir()
    elif there == "a file":
        bag.write_text("mine")
    else:
        shutil.copytree(walked.bag, bag)
    Path("o").mkdir()
    for name in (TABLE, SUMMARY, "cycles.csv"):
        Path("o", name).write_text("mine")
    before = {file: file.stat() for file in [bag, *bag.glob("*"), *Path("o").iterdir()]}
    for out in ("new", "o"):
        said = mistake(
            run, verb, "--cycles", 1, "--on", "loop", "--force", "--out", out, "--bag", bag
        )
        assert "bag is there already" in said
    assert not Path("new").exists()
    assert {file: file.stat() for file in [bag, *bag.glob("*"), *Path("o").iterdir()]} == before


@needs_bullet
@pytest.mark.parametrize("bag", ["/proc/ember/bag", "file/bag"])
def test_a_bag_that_cannot_be_made_costs_nothing(run: Go, bag: str) -> None:
    """Said in a line with its name; what an earlier run left is still there, even with --force."""
    Path("file").write_text("mine")
    Path("o").mkdir()
    for name in (TABLE, SUMMARY, "cycles.csv"):
        Path("o", name).write_text("mine")
    said = mistake(
        run, "walk", "--cycles", 1, "--on", "loop", "--force", "--out", "o", "--bag", bag
    )
    gc.collect()  # a file that was left open would warn here
    assert bag in said
    assert {file.name: file.read_text() for file in Path("o").iterdir()} == dict.fromkeys(
        (TABLE, SUMMARY, "cycles.csv"), "mine"
    )


@pytest.mark.parametrize("words", [("--split-s", -1), ("--split-mb", "much")])
def test_a_bad_option_of_recording_is_said(run: Go, words: Sequence[Any]) -> None:
    """Exit code 2, and nothing is made."""
    text = run("walk", "--cycles", 1, "--on", "loop", "--bag", "bag", *words, code=2)
    assert words[0] in text
    assert str(words[1]) in text
    assert list(Path().iterdir()) == []
