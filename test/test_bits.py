"""The same bits on every CPU: short runs in child processes that are told to be other machines.

``python test/test_bits.py`` prints ``GOLDEN`` and ``TRAINED`` anew, for a change that is meant to
change a run.
"""

from __future__ import annotations

import json
import platform
import sys
from typing import Any

import pytest

from ember_ros.params_file import load_params
from ember_ros.run_config import RunConfig
from ember_ros.shipped import BAG, DATA
from support.command import child, environment
from support.needs import needs_bullet
from support.runs import run_and_record

pytestmark = needs_bullet

RUNS = """
import json, tempfile
from pathlib import Path
from ember_ros.loop import Loop
from ember_ros.params_file import load_params
from ember_ros.run_config import RunConfig
from ember_ros.report.run_statistics import RunStatistics
from leg_node.table_file import save_table

def run(config):
    loop, recorder = Loop(config), RunStatistics(config.params, config.legs)
    for _ in range(config.cycles * config.params.gait.ticks):
        loop.tick(recorder)
    recorder.finish(loop.world.observe(), loop.world.body())
    table, found = loop.finish(), recorder.summary()
    loop.close()
    kinds = ("senses", "commands", "transitions")
    return table, {kind: found[f"{kind}_sha256"] for kind in kinds} | {"table": table.sha256()}

told = {}
with tempfile.TemporaryDirectory() as folder:
    for learner, files in (("plain", ["plain"]), ("ember", [])):
        params, start = load_params(*files), Path(folder) / f"{learner}.npz"
        table, told[f"{learner}, trainer"] = run(RunConfig("trainer", 60, seed=3, params=params))
        save_table(start, table, params, 3)
        config = RunConfig("walker", 12, seed=4, params=params, table=start)
        told[f"{learner}, walker"] = run(config)[1]
print(json.dumps(told))
"""

GOLDEN: dict[str, dict[str, str]] = {
    "plain, trainer": {
        "senses": "f8e9abb12683f3ab0bcb5ee8afb36b5a32cf9438e75bd36a9a89524f5fd378eb",
        "commands": "83e517601e4d2e5288cf9a4c57f3e4c446e514a3c0a58c6ba9ce53a4f45ac8ac",
        "transitions": "acb01f939d2debf3a4d9b0f26ce3c014336697d5fe0bc2360f3893f2d335a6cc",
        "table": "b39cfc78bf78426154e4e682fac5c22a124c0500bb6fecbd098627b91cfac7e7",
    },
    "plain, walker": {
        "senses": "d9f4d3d1b610ada0320a3ac4b0f0dd35583fd2e35f7c06e9d88ac2fa23dfad5b",
        "commands": "ccf803bba15b9a278c885a56696d21b507625a8bfe0aec196b914190c1f116c8",
        "transitions": "f632076d7bea88b6f96803bd29fb568aee75be778062b0da365b98b1540e2431",
        "table": "796106008a21fe59e4cbe87c6747d1115dc7c9be491066c227639d65ceed9b4f",
    },
    "ember, trainer": {
        "senses": "32068e6c18756b00c0308ffc40f5e27d8da621125d91d40beaf47de9b8de84e9",
        "commands": "2de3075bc1eef968a7a0f0012df34eb8e4d8f65d949953e3b39920b2b1fabaab",
        "transitions": "8234abc9ce6efb1a98beae6a72f4533c4d22d5cfd71e3096bcb75b143fc3d383",
        "table": "a57110bf8372f34fc11781b399bc57c7744e8f02a5f013eac167b9590f9bf210",
    },
    "ember, walker": {
        "senses": "da4668a48bfeadba7c885b5305b0af8cbb51fb4a3741a2dbabde845fd4704e73",
        "commands": "638ab2a830dac62c43d5940f1e3342fffc5bf8e80f245dd1fba2942448d6a8c2",
        "transitions": "cfdeb46e60c87e25ef007dd38460035826441874b2ee51ee63a64a2e27d0ac6c",
        "table": "580703620873142eb657f38ddb24cb6972a9f9e22c81f3317db496ce2cd5738a",
    },
}

TRAINED = {
    "senses": "4a52b8d5e272d394bda36c38adeca91acb94a47587aefc97e545f0af6a582001",
    "commands": "149c54b6deb87e2078668e1dbcb23b7c59ddcd6fb3234c13c44fde938da573b1",
    "transitions": "99b6528fca91e0f97cbb6b366964696d31b78aae765753058731f940f59e5aa2",
    "table": "8d674fbd9975f4f45262590588b89aae1d6e84bc390b67f0cc31b14714aed21a",
}

OLD_LIBRARY = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2_Usable,-FMA_Usable,-AVX2,-FMA,-AVX512F"}
"""The C library's sines and cosines as on a CPU of before 2013, which round otherwise."""
OTHERS: dict[str, dict[str, str]] = {
    **{
        f"OpenBLAS for {core}": {"OPENBLAS_CORETYPE": core}
        for core in ("Haswell", "Zen", "Sandybridge", "Prescott", "Nehalem")
    },
    "two threads": {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"},
    "numpy without AVX": {"NPY_DISABLE_CPU_FEATURES": "X86_V4 X86_V3 AVX512F AVX2 FMA3"},
    "another locale and hash seed": {"LC_ALL": "C", "PYTHONHASHSEED": "7", "TZ": "Asia/Tokyo"},
}
"""What makes a process compute as on another machine. numpy says what it cannot switch off in a
warning, and goes on."""


def hashes(**variables: str) -> dict[str, Any]:
    """Return the hashes of all runs in a process with these variables."""
    names = {name for other in (*OTHERS.values(), OLD_LIBRARY) for name in other}
    clean = {name: value for name, value in environment().items() if name not in names}
    done = child([sys.executable, "-W", "ignore", "-c", RUNS], env={**clean, **variables})
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def held() -> bool:
    """Return whether the figures below were made for this machine's kind: one wheel of PyBullet."""
    return (sys.platform, platform.machine()) == ("linux", "x86_64")


@pytest.mark.skipif(not held(), reason="PyBullet's own arithmetic is held on x86-64 Linux alone")
@pytest.mark.slow
def test_the_bits_are_those_that_were_written_down() -> None:
    """Senses, commands, rewards and table of both learners, on the trainer and on the body."""
    assert hashes() == GOLDEN


@pytest.mark.slow
@pytest.mark.parametrize("other", list(OTHERS))
def test_the_bits_do_not_hang_on_the_machine(other: str) -> None:
    """Whichever BLAS kernel, SIMD set, number of threads or locale it is."""
    assert hashes(**OTHERS[other]) == (GOLDEN if held() else hashes())


def test_a_replay_needs_no_sine_of_the_c_library() -> None:
    """What legs make of their senses is the same with another C library, where physics is not.

    Bullet works with the C library's sines; a recorded walk has its senses in the bag.
    """
    code = (
        "from pathlib import Path\n"
        "from ember_ros.bag.reader import Bag\n"
        "from ember_ros.offline.replay import replay\n"
        f"with Bag(Path({str(DATA / BAG)!r})) as bag:\n"
        "    done = replay(bag)\n"
        "print(done.equal, done.ticks, done.table.sha256() == done.recorded_sha256)\n"
    )
    done = child([sys.executable, "-c", code], env=environment(**OLD_LIBRARY))
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["True", "1280", "True"]


# -- learning ------------------------------------------------------------------------------------


def trained(*, learning: bool = True) -> tuple[dict[str, str], list[float]]:
    """Return the hashes of a training of plain in Bullet, and the reward of each of its cycles."""
    config = RunConfig("trainer", 300, seed=3, params=load_params("plain"), learning=learning)
    table, recorder = run_and_record(config)
    found = recorder.summary()
    kinds = ("senses", "commands", "transitions")
    told = {kind: found[f"{kind}_sha256"] for kind in kinds} | {"table": table.sha256()}
    return told, [row.reward for row in recorder.body_rows()]


@pytest.mark.slow
def test_a_leg_learns_in_bullet_and_does_so_bit_for_bit() -> None:
    """300 cycles end with the bits that were written down, and from third to third earn more.

    A leg that explores as much and learns nothing earns less in its last third.
    """
    told, rewards = trained()
    assert told == (TRAINED if held() else trained()[0])
    thirds = [sum(rewards[n : n + 100]) for n in (0, 100, 200)]
    assert thirds[0] < thirds[1] < thirds[2]
    assert sum(trained(learning=False)[1][200:]) < thirds[2]


if __name__ == "__main__":
    print(json.dumps({"GOLDEN": hashes(), "TRAINED": trained()[0]}, indent=4))
