"""Versions and provenance of a run: bits depend on the versions only."""

from __future__ import annotations

import datetime
from pathlib import Path

import pytest

import ember_ros
from ember_ros import versions as versions_module
from ember_ros.experiments.trial import Trial
from support.command import child

PROVENANCE_FIELDS = ("date", "system", "cpu", "simd", "blas", "commit")


def git(folder: Path, *args: str) -> str:
    """Run git in a folder with a fixed author; return its output."""
    author = ("-c", "user.name=Some One", "-c", "user.email=one@example.org")
    done = child(["git", *author, *args], cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_provenance_has_all_fields_and_a_date_in_utc() -> None:
    """No field is empty, and the date is the present one in UTC."""
    provenance = versions_module.provenance()
    assert tuple(provenance) == PROVENANCE_FIELDS
    assert all(provenance.values())
    date = datetime.datetime.fromisoformat(provenance["date"])
    assert date.utcoffset() == datetime.timedelta(0)
    assert abs(datetime.datetime.now(datetime.timezone.utc) - date) < datetime.timedelta(minutes=1)


def test_versions_and_trial_names_do_not_depend_on_provenance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another machine changes neither the versions nor the key of a trial."""
    before = versions_module.versions(), Trial("walker", 1, 0).key
    monkeypatch.setattr(
        versions_module, "_machine", lambda: dict.fromkeys(PROVENANCE_FIELDS[1:], "another")
    )
    assert (versions_module.versions(), Trial("walker", 1, 0).key) == before
    assert not set(PROVENANCE_FIELDS) & set(versions_module.versions())


def test_commit_is_that_of_the_package_checkout(tmp_path: Path) -> None:
    """A changed checkout is marked; a file that the checkout does not track has no commit."""
    git(tmp_path, "init", "-q")
    file = tmp_path / "package.py"
    file.write_text("1\n", encoding="utf-8")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "one")
    commit = git(tmp_path, "rev-parse", "HEAD")
    assert versions_module._commit(file) == commit
    file.write_text("2\n", encoding="utf-8")
    assert versions_module._commit(file) == f"{commit}, changed"
    installed = tmp_path / "site-packages.py"
    installed.write_text("", encoding="utf-8")
    assert versions_module._commit(installed) == "unknown"


def test_commit_is_unknown_without_git(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without git there is no error."""
    monkeypatch.setenv("PATH", "/nowhere")
    assert versions_module._commit(Path(ember_ros.__file__)) == "unknown"
