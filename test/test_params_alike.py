"""One parameter file means the same to ``ember`` and to a node, or ``ember`` refuses it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ember_ros.errors import ParameterError
from ember_ros.params import SPECS, Params, flat
from ember_ros.params_file import changed, load_params, read_settings

pytestmark = pytest.mark.ros

HEAD = "/**:\n  ros__parameters:\n"


def in_file(file: Path, text: str) -> Path:
    """Return a file with this text."""
    file.write_bytes(text.encode())
    return file


def by_node(*files: Path) -> dict[str, Any] | None:
    """Return what a node reads; None where rcl or the node refuses it."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from ember_ros.ros_params import declare_params

    context = rclpy.Context()
    try:
        rclpy.init(
            args=["--ros-args", "--log-level", "fatal"]
            + [word for file in files for word in ("--params-file", str(file))],
            context=context,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        node = rclpy.create_node(
            "sim_node",
            context=context,
            automatically_declare_parameters_from_overrides=True,
            enable_rosout=False,
            start_parameter_services=False,
        )
    except Exception:  # rclpy's own errors are not public
        context.try_shutdown()
        return None
    try:
        groups = sorted({name.split(".")[0] for name in SPECS})
        return dict(flat(declare_params(node, groups)))
    except ParameterError:
        return None
    finally:
        node.destroy_node()
        context.try_shutdown()


def by_ember(*files: Path) -> dict[str, Any] | str:
    """Return what ``ember --params`` reads, or why it does not."""
    try:
        return dict(flat(load_params(*files)))
    except ParameterError as error:
        return str(error)


def alike(file: Path) -> dict[str, Any] | str:
    """Hold that the two readers agree, or that ember refuses in one bounded line; return that."""
    read = by_ember(file)
    if isinstance(read, str):
        assert "\n" not in read
        assert len(read) < 400 + len(str(file))
    else:
        assert read == by_node(file)
    return read


SCALARS = (
    "5e-03", "5.e-3", ".5", "1e3", "0x10", "010", "09", "1_000", "1:30", "+3", "-0.0", "0.006 ",
    "'0.01'", '"0.01"', "yes", "True", "~", "null", "", ".inf", "-.INF", "nan", "1e400",
    "2001-01-01", "2001-13-45", "!!float 1", "!!int abc", "&a 0.01", "*a", "[0.1, 0.2]", "[1, 0.5]",
    "[0.5, 1]", "[]", "[[0.1]]", "{a: 1}", "1.0e+0", "9223372036854775807", "9223372036854775808",
    "9" * 5000, "[" * 3000, "- 1", "0.01 # a word", "0,5", "1.2.3", "0b1", "0o17", "1e", "--1",
    "1e-310", "-1e-400", "0e-400", "0.0", "2.2250738585072014e-308",
    "mine.rewards.Mine", "'mine.Mine'", "mine:Mine", "[a, b, c, d]", "['a', b, c, d]", "[a, b]",
    "[a, 1, c, d]", "['1', a, b, c]", "[a, yes, c, d]", "[a, a, c, d]", "a, b",
)  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        "reward.slip_scale",
        "train.epsilon_cycles",
        "state.force_edges",
        "trainer.modulation",
        "parts.reward",
        "robot.legs",
    ],
)
@pytest.mark.parametrize("scalar", SCALARS, ids=lambda text: text[:20])
def test_every_way_to_write_a_value(tmp_path: Path, name: str, scalar: str) -> None:
    """A number, a whole one, a list, a text, names, in ways that readers of YAML differ in."""
    group, field = name.split(".")
    alike(in_file(tmp_path / "p.yaml", f"{HEAD}    {group}:\n      {field}: {scalar}\n"))


FORMS = {
    "dotted": HEAD + "    walker.length: 1.0\n",
    "nested and dotted": HEAD + "    walker:\n      length: 1.0\n    walker.length: 1.1\n",
    "group twice": HEAD + "    walker:\n      length: 1.0\n    walker:\n      radius: 0.1\n",
    "section twice": HEAD + "    walker.length: 1.0\n" + HEAD + "    walker.radius: 0.1\n",
    "two documents": HEAD + "    walker.length: 1.0\n---\n" + HEAD + "    walker.radius: 0.1\n",
    "a node's section": "sim_node:\n  ros__parameters:\n    walker.length: 1.0\n",
    "a namespace": "/robot_2/sim_node:\n  ros__parameters:\n    walker.length: 1.0\n",
    "a wildcard": "/*:\n  ros__parameters:\n    walker.length: 1.0\n",
    "beside it": HEAD + "    walker.length: 1.0\nsim_node:\n  ros__parameters:\n    seed: 3\n",
    "sim time": HEAD + "    use_sim_time: true\n    walker.length: 1.0\n",
    "qos": HEAD + "    qos_overrides:\n      /clock:\n        publisher:\n          depth: 3\n",
    "a node's option": HEAD + "    seed: 3\n",
    "merge key": HEAD + "    walker: &w\n      length: 1.0\n    leg:\n      <<: *w\n",
    "anchors": "a: &a [1,1]\nb: [" + "*a, " * 50 + "*a]\n",
    "empty": "",
    "a comment": "# nothing\n",
    "a list": "- 1\n",
    "no parameters": "/**:\n  ros__parameters:\n",
    "tabs": "/**:\n\tros__parameters:\n",
    "a zero byte": HEAD + "    walker.length: 1.0\0\n",
    "unclosed": HEAD + "    walker: {length: 1.0\n",
    "flow": "{/**: {ros__parameters: {walker: {length: 1.0}}}}\n",
    "unknown": HEAD + "    walker.lenght: 1.0\n",
    "windows lines": (HEAD + "    walker.length: 1.0\n").replace("\n", "\r\n"),
    "empty group": HEAD + "    walker: {}\n    gait:\n      period: 1.0\n",
    "empty list for ROS": HEAD + "    use_sim_time: []\n    walker.length: 1.0\n",
    "nothing for ROS": HEAD + "    qos_overrides:\n      a:\n    walker.length: 1.0\n",
    "lists in a list": HEAD + "    qos_overrides: {a: [[1], [2]]}\n    walker.length: 1.0\n",
    "groups in a list": HEAD + "    qos_overrides: {a: [{b: 1}]}\n    walker.length: 1.0\n",
    "colon in braces": HEAD + "    qos_overrides: {a: x:y}\n    walker.length: 1.0\n",
    "question in brackets": HEAD + "    qos_overrides: {a: [?x]}\n    walker.length: 1.0\n",
    "another YAML": "%YAML 1.2\n---\n" + HEAD + "    walker.length: 1.0\n",
    "deep": HEAD + "    " + "{a: " * 2000 + "1" + "}" * 2000,
}


@pytest.mark.parametrize("form", list(FORMS))
def test_every_form_of_a_file(tmp_path: Path, form: str) -> None:
    """What is not plain is refused, by its own name, or read as nodes read it."""
    read = alike(in_file(tmp_path / "p.yaml", FORMS[form]))
    good = {"dotted", "sim time", "flow", "windows lines", "qos"}
    assert isinstance(read, dict) is (form in good), read


NESTED, DOTTED = "    walker:\n      mass: {}\n", "    walker.mass: {}\n"


@pytest.mark.parametrize(
    ("first", "second", "good"),
    [
        (NESTED.format(4), NESTED.format(5.5), True),
        (DOTTED.format(4), NESTED.format(5.5), True),
        (NESTED.format(4), DOTTED.format(5.5), False),  # a node takes 4
        (DOTTED.format(4), DOTTED.format(5.5), False),  # here too
        (NESTED.format(4.5), "    walker.length: 1.0\n", True),
    ],
)
def test_the_later_of_two_files_wins_for_nodes_too(
    tmp_path: Path, first: str, second: str, good: bool
) -> None:
    """Two files are one robot to both; where a node would not take the later, ember takes none."""
    files = [in_file(tmp_path / name, HEAD + text) for name, text in (("a", first), ("b", second))]
    read = by_ember(*files)
    assert isinstance(read, dict) is good, read
    if good:
        assert read == by_node(*files)
    else:
        assert "'walker.mass' too" in str(read)


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    """A pipe that nobody writes to, a folder, a gigabyte, bytes that are no text."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    with (tmp_path / "large").open("wb") as large:
        large.truncate(1 << 30)
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00")
    for name in ("pipe", "folder", "large", "bytes", "none"):
        with pytest.raises(ParameterError, match=name):
            load_params(tmp_path / name)


numbers = st.one_of(
    st.floats(1e-5, 0.9).map(repr),
    st.floats(1e-5, 0.9).map(lambda x: f"{x:.3e}"),
    st.integers(-3, 40).map(str),
    st.text("0123456789.eE+-_xabf:'", min_size=1, max_size=7),
)


@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    values=st.dictionaries(
        st.sampled_from(["reward.slip_scale", "train.gamma", "walk.visits_own", "gait.period"]),
        numbers,
        min_size=1,
    ),
    flow=st.booleans(),
)
def test_any_numbers(tmp_path: Path, values: dict[str, str], flow: bool) -> None:
    """Whatever is written for a number, the two read one and the same robot, or ember refuses."""
    lines = [f"{name}: {value}" for name, value in values.items()]
    text = f"/**: {{ros__parameters: {{{', '.join(lines)}}}}}\n" if flow else HEAD
    if not flow:
        text += "".join(f"    {line}\n" for line in lines)
    alike(in_file(tmp_path / "p.yaml", text))


def test_set_is_read_as_a_file_is() -> None:
    """On top of what is there, all together; with a hint where a name is wrong."""
    params = changed(Params(), ["walker.length=1e0", "state.force_edges=[0.1, 1.0]"])
    assert (params.walker.length, params.state.force_edges) == (1.0, (0.1, 1.0))
    together = changed(Params(), ["trainer.stop_low=0.6", "trainer.stop_high=0.7"])
    assert together.trainer.stop_low == 0.6
    assert read_settings(["trainer.stop_low=0.6"]) == {"trainer.stop_low": 0.6}
    for setting, why in {
        "walker.lenght=1.0": "did you mean walker.length",
        "walker.length": "group.field=value would be right",
        "walker.length=": "empty",
        "walker.length=1_0": "must be a number",
        "walker.length=[1.0": "not YAML",
        "walker.length=*a": "anchors",
    }.items():
        with pytest.raises(ParameterError, match=why):
            changed(Params(), [setting])
