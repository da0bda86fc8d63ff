"""What is told of a run's origin: what decides, and apart from it what does not."""

from __future__ import annotations

import datetime
from pathlib import Path

import pytest

import ember_ros
from ember_ros import versions as told
from ember_ros.experiments.trial import Trial
from support.command import child

WHERE = ("date", "system", "cpu", "simd", "blas", "commit")


def git(folder: Path, *what: str) -> str:
    """Run git in a folder, as a person of its own."""
    person = ("-c", "user.name=Some One", "-c", "user.email=one@example.org")
    done = child(["git", *person, *what], cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_where_and_when_a_run_was() -> None:
    """Everything is told in words, the date in UTC."""
    where = told.provenance()
    assert tuple(where) == WHERE
    assert all(where.values())
    date = datetime.datetime.fromisoformat(where["date"])
    assert date.utcoffset() == datetime.timedelta(0)
    assert abs(datetime.datetime.now(datetime.timezone.utc) - date) < datetime.timedelta(minutes=1)


def test_where_and_when_decide_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the versions nor the name of a trial know of it."""
    before = told.versions(), Trial("walker", 1, 0).key
    monkeypatch.setattr(told, "_here", lambda: dict.fromkeys(WHERE[1:], "another"))
    assert (told.versions(), Trial("walker", 1, 0).key) == before
    assert not set(WHERE) & set(told.versions())


def test_the_commit_is_that_of_the_package(tmp_path: Path) -> None:
    """Of a checkout, whether it was changed too; of files that are merely inside one, nothing."""
    git(tmp_path, "init", "-q")
    file = tmp_path / "package.py"
    file.write_text("1\n", encoding="utf-8")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "one")
    commit = git(tmp_path, "rev-parse", "HEAD")
    assert told._commit(file) == commit
    file.write_text("2\n", encoding="utf-8")
    assert told._commit(file) == f"{commit}, changed"
    installed = tmp_path / "site-packages.py"
    installed.write_text("", encoding="utf-8")
    assert told._commit(installed) == "unknown"


def test_no_commit_without_git(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without git runs everything all the same."""
    monkeypatch.setenv("PATH", "/nowhere")
    assert told._commit(Path(ember_ros.__file__)) == "unknown"
