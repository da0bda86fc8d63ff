"""The same bits on every CPU: short runs in child processes that are told to be other machines.

``python test/test_bits.py`` prints ``GOLDEN`` anew, for a change that is meant to change a run.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.skipif(find_spec("pybullet") is None, reason="pybullet is missing")

RUNS = """
import json, tempfile
from pathlib import Path
from ember_ros.loop import Loop
from ember_ros.params_file import load_params
from ember_ros.plan import Plan
from ember_ros.report.recorder import Recorder
from leg_node.table_file import save_table

def run(plan):
    loop, recorder = Loop(plan), Recorder(plan.params, plan.legs)
    for _ in range(plan.cycles * plan.params.gait.ticks):
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
        table, told[f"{learner}, trainer"] = run(Plan("trainer", 60, seed=3, params=params))
        save_table(start, table, params, 3)
        plan = Plan("walker", 12, seed=4, params=params, table=start)
        told[f"{learner}, walker"] = run(plan)[1]
print(json.dumps(told))
"""

GOLDEN: dict[str, dict[str, str]] = {
    "plain, trainer": {
        "senses": "5136a704393bd30f3009ba38c3620eee58a5e7f8992269809f858a05ae0a8c78",
        "commands": "0d19f6e9069f851fa01681ba085db8bddb21039a26a910654e84c8a2d4ed7af6",
        "transitions": "1378c390f9e38f833cc71e9766d9bd7ca5bd9f08ef373390a001c1ec0564cd56",
        "table": "a95abc003c2751e017c36979627ee769057c44cb30d8d22ef6cb6912a1e4ca6d",
    },
    "plain, walker": {
        "senses": "693a156a647817432873906245720219b8dde814b9dcadcba96045101338ee81",
        "commands": "521450f60678fb58c7d0b52c4c08f52d7ea2473e6715068dd590635d972f5309",
        "transitions": "afe13c3b46b8a354d2d64abc05e9efa14e72951a1a6a3d1a39825ab97cbe319d",
        "table": "e4ebeb359ec9320a987112270db1ff802e03c0a82376ed4770ac92399a1d9d56",
    },
    "ember, trainer": {
        "senses": "333e3c1507c9758ace390cb592e2b7efbce4b3df35924be991d72483c9fa646d",
        "commands": "308786bdd43636032e71824862836e3ca7034aa34858be4707e6a34792b53f4d",
        "transitions": "580c4b00a621a7121e7465e897bc4792e3ae383e3abcf05f5c89c538bbe786b4",
        "table": "61daa5f22c34d1bd4af5bdde6ac447421d1b79fc31a014369f7bfd4979ee8cd9",
    },
    "ember, walker": {
        "senses": "30ac57237c0648b7463c60d073d492b22de070c30c93ad284c27fea68edfeeea",
        "commands": "ecf506ae6fdb07b1c12211ebe3e26355e3b0b12f38bc018853e5d040c64e124a",
        "transitions": "b53d847d80f61b411bf773acffea9631094722ae16c8377e63765e51ca01760e",
        "table": "5bdd6c6d2de55aaa3c75fa2cbcd7e6995b90330d261b40a801aef9b9f01e156b",
    },
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


def hashes(**environment: str) -> dict[str, Any]:
    """Return the hashes of all runs in a process with these variables."""
    names = {name for other in (*OTHERS.values(), OLD_LIBRARY) for name in other}
    clean = {name: value for name, value in os.environ.items() if name not in names}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", RUNS],
        env={**clean, **environment, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def held() -> bool:
    """Return whether the figures below were made for this machine's kind: one wheel of PyBullet."""
    return (sys.platform, platform.machine()) == ("linux", "x86_64")


@pytest.mark.skipif(not held(), reason="PyBullet's own arithmetic is held on x86-64 Linux alone")
def test_the_bits_are_those_that_were_written_down() -> None:
    """Senses, commands, rewards and table of both learners, on the trainer and on the body."""
    assert hashes() == GOLDEN


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
        "from ember_ros.bag.reading import Bag\n"
        "from ember_ros.bag.replay import replay\n"
        f"with Bag(Path({str(ROOT / 'bags' / 'walk')!r})) as bag:\n"
        "    done = replay(bag)\n"
        "print(done.equal, done.ticks, done.table.sha256() == done.recorded_sha256)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **OLD_LIBRARY, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["True", "1280", "True"]


if __name__ == "__main__":
    print(json.dumps(hashes(), indent=4))
