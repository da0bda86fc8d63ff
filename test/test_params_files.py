"""Parameter files: several at once, by path or by the name of one that comes with the package."""

from __future__ import annotations

from pathlib import Path

import pytest

from ember_ros.errors import ParameterError
from ember_ros.params import Params, as_dict, cells_sha256, flat, replace
from ember_ros.params_file import CONFIG, config_names, dump_params, load_params, robot_legs


def test_every_file_that_comes_with_the_package_is_one() -> None:
    """Each can be read by its name and by its path, and says the same."""
    assert {
        "plain",
        "reference",
        "easy",
        "short",
        "narrow",
        "modulated",
        "hexapod",
    } == set(config_names())
    for name in config_names():
        assert load_params(name) == load_params(CONFIG / f"{name}.yaml")


def test_reference_is_the_default() -> None:
    """The reference body and the ember learner need no file."""
    assert load_params("reference") == load_params() == Params()


@pytest.mark.parametrize(
    ("name", "length", "half_width"),
    [("reference", 1.2, 0.22), ("easy", 1.2, 0.35), ("short", 0.8, 0.20), ("narrow", 1.2, 0.14)],
)
def test_a_body_is_a_body_alone(name: str, length: float, half_width: float) -> None:
    """A body's file changes the body and nothing else, so that every table fits in every body."""
    params = load_params(name)
    assert (params.walker.length, params.walker.hip_half_width) == (length, half_width)
    changed = {full for full, value in flat(params) if value != dict(flat(Params()))[full]}
    assert changed <= {"walker.length", "walker.hip_half_width"}


def test_plain_is_the_papers_learner() -> None:
    """A constant rate, the table as it is, a reward that switches with the hip; no other change."""
    plain, default = load_params("plain"), Params()
    for learning_params in (plain.train, plain.walk):
        assert learning_params.rate.floor == learning_params.rate.ceiling
        assert learning_params.smooth == learning_params.prior == 0.0
    assert plain.reward.lead == 0
    same = [group for group, part in as_dict(plain).items() if part == as_dict(default)[group]]
    assert set(same) == {
        "gait",
        "leg",
        "physics",
        "trainer",
        "walker",
        "robot",
        "parts",
        "state",
        "script",
    }


def test_a_later_file_wins(tmp_path: Path) -> None:
    """What both name is the later one's; what one names stays."""
    (tmp_path / "mine.yaml").write_text("/**: {ros__parameters: {walker: {length: 0.9}}}")
    params = load_params("plain", "narrow", tmp_path / "mine.yaml")
    assert (params.walker.length, params.walker.hip_half_width) == (0.9, 0.14)
    assert params.train == load_params("plain").train
    assert load_params(tmp_path / "mine.yaml", "narrow").walker.length == 1.2


def test_a_file_here_comes_before_one_of_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who has a file called ``plain`` in the folder means that one."""
    monkeypatch.chdir(tmp_path)
    Path("plain").write_text(dump_params(Params()))
    assert load_params("plain") == Params()


def test_a_name_of_nothing_is_told_with_those_there_are() -> None:
    """A slip of the pen is answered with the names."""
    with pytest.raises(ParameterError, match=r"narow.*easy, hexapod, modulated, narrow, plain"):
        load_params("narow")


@pytest.mark.parametrize("option", ["seed", "world", "leg_name", "cycles"])
def test_an_option_of_nodes_is_told_from_a_number_of_the_robot(tmp_path: Path, option: str) -> None:
    """A node takes it from the same section; ``ember`` has an option of its own for it."""
    file = tmp_path / "p.yaml"
    file.write_text(f"/**: {{ros__parameters: {{{option}: 3}}}}")
    with pytest.raises(ParameterError, match=rf"{option} is an option of nodes.*-p {option}:="):
        load_params(file)


def test_the_hexapod_is_another_body_for_the_same_leg() -> None:
    """It changes the body alone, so that every table fits; six legs in an alternating tripod."""
    params = load_params("hexapod")
    changed = {full for full, value in flat(params) if value != dict(flat(Params()))[full]}
    assert {name.split(".")[0] for name in changed} == {"robot", "walker"}
    assert cells_sha256(params) == cells_sha256(Params())
    robot = params.robot
    assert len(robot.legs) == 6
    tripods = [
        {leg for leg, offset in zip(robot.legs, robot.offset, strict=True) if offset == half}
        for half in (0.0, 0.5)
    ]
    assert tripods[0] == {"front_left", "middle_right", "rear_left"}
    assert tripods[1] == {"front_right", "middle_left", "rear_right"}


def test_texts_and_lists_of_them_come_from_a_file_and_back(tmp_path: Path) -> None:
    """Written out and read again, the same robot; by ``--set`` too."""
    params = replace(load_params("hexapod"), {"parts.reward": "mine.rewards.Mine"})
    file = tmp_path / "p.yaml"
    file.write_text(dump_params(params))
    assert load_params(file) == params
    assert load_params("hexapod", settings=["parts.reward=mine.rewards.Mine"]) == params
    told = load_params(settings=["robot.legs=[a, b, c, d]"])
    assert told.robot.legs == ("a", "b", "c", "d")


def test_the_legs_of_a_robot_are_read_for_what_starts_nodes(tmp_path: Path) -> None:
    """The last file that names any; options of nodes in it are no matter."""
    file = tmp_path / "p.yaml"
    file.write_text("/**: {ros__parameters: {seed: 3, robot: {legs: [a, b]}}}")
    assert robot_legs([]) == Params().robot.legs
    assert robot_legs([CONFIG / "hexapod.yaml"]) == load_params("hexapod").robot.legs
    assert robot_legs([CONFIG / "hexapod.yaml", file]) == ("a", "b")
    assert robot_legs([file, CONFIG / "plain.yaml"]) == ("a", "b")
    file.write_text("/**: {ros__parameters: {robot: {legs: [A]}}}")
    with pytest.raises(ParameterError, match=r"robot\.legs must be a name in lower case"):
        robot_legs([file])
    with pytest.raises(ParameterError, match=r"none\.yaml"):
        robot_legs([tmp_path / "none.yaml"])
