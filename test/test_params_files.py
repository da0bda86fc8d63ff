"""Parameter files: several at once, by path or by the name of one that comes with the package."""

from __future__ import annotations

from pathlib import Path

import pytest

from ember_ros.errors import ParameterError
from ember_ros.params import Params, as_dict, flat
from ember_ros.params_file import CONFIG, config_names, dump_params, load_params


def test_every_file_that_comes_with_the_package_is_one() -> None:
    """Each can be read by its name and by its path, and says the same."""
    assert {"plain", "reference", "easy", "short", "narrow", "modulated"} == set(config_names())
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
    for numbers in (plain.train, plain.walk):
        assert numbers.rate.floor == numbers.rate.ceiling
        assert numbers.smooth == numbers.prior == 0.0
    assert plain.reward.lead == 0
    same = [group for group, part in as_dict(plain).items() if part == as_dict(default)[group]]
    assert set(same) == {"gait", "leg", "physics", "trainer", "walker", "state"}


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
    with pytest.raises(ParameterError, match=r"narow.*easy, modulated, narrow, plain"):
        load_params("narow")


@pytest.mark.parametrize("option", ["seed", "world", "leg_name", "cycles"])
def test_an_option_of_nodes_is_told_from_a_number_of_the_robot(tmp_path: Path, option: str) -> None:
    """A node takes it from the same section; ``ember`` has an option of its own for it."""
    file = tmp_path / "p.yaml"
    file.write_text(f"/**: {{ros__parameters: {{{option}: 3}}}}")
    with pytest.raises(ParameterError, match=rf"{option} is an option of nodes.*-p {option}:="):
        load_params(file)
