"""A recording that was read in every way is known as one that can be read, by every process, until it changes."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from springbench.harness.errors import InputError
from springbench.harness.recording import recording_integrity
from springbench.harness.recording.recording_integrity import mark_verified, require_intact

from tests.synthetic_recordings import write_recording


def refuse(path: Path) -> None:
    """A reader that can read nothing."""
    raise ValueError("it is read")


def another_process() -> None:
    recording_integrity._verified_states.clear()
    recording_integrity._notes_offset.clear()


@pytest.fixture
def recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = write_recording(tmp_path / "a.rrd")
    another_process()
    return path


def test_a_recording_checked_by_one_process_is_not_checked_again_by_another(recording: Path):
    require_intact(recording, refuse)
    other = recording.with_name("b.rrd")
    other.write_bytes(recording.read_bytes())  # another file, of the same bytes
    with pytest.raises(InputError, match="it is read"):
        require_intact(other, refuse)
    mark_verified(other, shared=False)
    require_intact(other, refuse)
    another_process()
    with pytest.raises(InputError, match="it is read"):
        require_intact(other, refuse)


def test_notes_added_meanwhile_are_read(recording: Path):
    other = recording.with_name("b.rrd")
    other.write_bytes(recording.read_bytes())
    require_intact(recording, refuse)
    known = recording_integrity._verified_states.copy()
    mark_verified(other)  # by another process, as it were
    recording_integrity._verified_states.clear()
    recording_integrity._verified_states.update(known)
    require_intact(other, refuse)


def test_a_recording_that_was_cut_or_changed_since_is_read_again_whatever_its_time_stamps(recording: Path):
    before, content = recording.stat(), recording.read_bytes()
    for changed in (content[:-100], content[:-100] + bytes(100)):
        recording.write_bytes(changed)
        os.utime(recording, ns=(before.st_atime_ns, before.st_mtime_ns))
        with pytest.raises(InputError, match="it is read"):
            require_intact(recording, refuse)


def test_notes_that_cannot_be_stored_are_no_failure(recording: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(recording))
    mark_verified(recording)
    require_intact(recording, refuse)


def test_notes_are_restarted_before_they_are_many(recording: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(recording_integrity, "_MAX_NOTES_BYTES", 64)
    for _ in range(20):
        mark_verified(recording)
    assert recording_integrity._notes_path().stat().st_size <= 64 + 16
    another_process()
    require_intact(recording, refuse)
