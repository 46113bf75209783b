"""Results are complete or as before, whenever a process is killed; the next one removes what is left."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lab.errors import InputError
from lab.files.output import part_folder
from lab.files.text.atomic_write import atomic_folder
from tests.paths import ROOT

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")

FILES = 8
# Replaces the results again and again; each time all files have the same content.
WRITER = f"""
import signal, sys
sys.path.insert(0, {str(ROOT)!r})
for name in ("SIGTERM", "SIGHUP", "SIGINT"):  # the tests may have been started with `nohup`, and commands respect that
    if hasattr(signal, name):
        signal.signal(getattr(signal, name), signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL)
from pathlib import Path
from lab.commands.common import stopped_by_signals
from lab.files.output import part_folder
from lab.files.text.atomic_write import atomic_folder, atomic_write_text
if sys.argv[1] == "two renames":
    part_folder.exchange = lambda one, other: False
with stopped_by_signals():
    for turn in range(10**9):
        with atomic_folder(Path(sys.argv[2]), lambda _: True) as work:
            for k in range({FILES}):
                atomic_write_text(str(turn) * 1000, work / str(k))
        if turn == 0:
            print("ready", flush=True)
"""
HOLDER = f"""
import sys, time
sys.path.insert(0, {str(ROOT)!r})
from pathlib import Path
from lab.files.text.atomic_write import atomic_folder
with atomic_folder(Path(sys.argv[1]), lambda _: True) as work:
    print("ready", flush=True)
    sys.stdin.read()
    (work / "a.csv").write_text("1")
"""


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def started(program: str, *arguments: str | Path) -> subprocess.Popen[str]:
    """A process that has printed that it is ready."""
    process = subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def are_complete(folder: Path) -> bool:
    """Whether all files are there, with one content."""
    return len(list(folder.iterdir())) == FILES and len({p.read_text() for p in folder.iterdir()}) == 1


def start_and_fail(target: Path) -> None:
    """A next command that recovers what the killed one left, and then fails."""
    with pytest.raises(ValueError, match="again"), atomic_folder(target, lambda _: True):
        raise ValueError("again")


def kill_at_random(folder: Path, way: str, sent: signal.Signals, seed: int) -> None:
    folder.mkdir()
    target = folder / "results"
    with started(WRITER, way, target) as writer:
        time.sleep(random.Random(seed).uniform(0, 0.05))
        writer.send_signal(sent)
        _, errors = writer.communicate(timeout=60)
    if sent == signal.SIGKILL:
        assert writer.returncode == -sent
        if way == "exchange" and sys.platform.startswith("linux"):
            assert are_complete(target)  # even before the next start
    else:
        assert (writer.returncode, errors) == (128 + sent, "")
        # A signal in the instant in which the file of the lock is made leaves that file; nobody holds it.
        assert set(names(folder)) <= {"results", ".results.beampose-lock"}
        assert are_complete(target)
    start_and_fail(target)
    assert are_complete(target)
    assert names(folder) == ["results"]


@pytest.mark.parametrize(
    ("sent", "way"),
    [("SIGKILL", "exchange"), ("SIGKILL", "two renames"), ("SIGTERM", "exchange"), ("SIGHUP", "two renames")],
)
def test_a_process_killed_at_any_moment_leaves_complete_results(tmp_path, way, sent):
    for seed in range(3):
        kill_at_random(tmp_path / str(seed), way, signal.Signals[sent], seed)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["exchange", "two renames"])
@pytest.mark.parametrize("sent", ["SIGKILL", "SIGTERM", "SIGHUP"])
def test_a_process_killed_at_any_of_many_moments_leaves_complete_results(tmp_path, way, sent):
    for seed in range(100, 140):
        kill_at_random(tmp_path / str(seed), way, signal.Signals[sent], seed)


def test_the_folder_of_a_living_process_is_kept_and_that_of_a_dead_one_removed(tmp_path):
    target = tmp_path / "results"
    with started(HOLDER, target) as holder:
        before = names(tmp_path)
        assert len(before) == 2  # part folder and lock
        with (
            pytest.raises(InputError, match=rf"in use by process {holder.pid} on .* since "),
            atomic_folder(target, lambda _: True),
        ):
            pytest.fail("the block must not begin")
        assert names(tmp_path) == before
        holder.communicate(input="", timeout=60)  # undisturbed, it completes its results
    assert holder.returncode == 0
    assert names(tmp_path) == ["results"]
    assert names(target) == ["a.csv"]
    with started(HOLDER, target) as holder:
        holder.kill()
    assert len(names(tmp_path)) == 3  # results, part folder and lock
    start_and_fail(target)
    assert names(tmp_path) == ["results"]


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_signal_between_any_two_renames_leaves_one_complete_folder(tmp_path, monkeypatch, which):
    target, rename, count = tmp_path / "results", Path.rename, iter(range(10))
    target.mkdir()
    (target / "a.csv").write_text("old")

    def renamed_and_stopped(self, to):
        rename(self, to)
        if next(count) == which:
            raise KeyboardInterrupt

    monkeypatch.setattr(part_folder, "exchange", lambda one, other: False)
    monkeypatch.setattr(Path, "rename", renamed_and_stopped)
    with pytest.raises(KeyboardInterrupt), atomic_folder(target, lambda _: True) as work:
        (work / "a.csv").write_text("new")
    assert names(tmp_path) == ["results"]
    assert (target / "a.csv").read_text() == ("old" if which == 0 else "new")


def test_a_process_killed_between_two_renames_loses_nothing(tmp_path):
    """The process kills itself there."""
    program = f"""
import os, sys
sys.path.insert(0, {str(ROOT)!r})
from pathlib import Path
from lab.files.output import part_folder
from lab.files.text.atomic_write import atomic_folder
part_folder.exchange = lambda one, other: False
rename = Path.rename
def rename_and_die(self, to):
    rename(self, to)
    if ".old-" in Path(to).name:
        os.kill(os.getpid(), 9)
Path.rename = rename_and_die
with atomic_folder(Path(sys.argv[1]), lambda _: True) as work:
    (work / "new.csv").write_text("1")
"""
    target = tmp_path / "results"
    target.mkdir()
    (target / "good.csv").write_text("1")
    done = subprocess.run([sys.executable, "-c", program, str(target)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert not target.exists()
    start_and_fail(target)
    assert names(tmp_path) == ["results"]
    assert names(target) == ["good.csv"]


def test_a_stop_whose_exception_is_lost_ends_the_process_all_the_same(tmp_path):
    program = f"""
import signal, sys, time
sys.path.insert(0, {str(ROOT)!r})
from pathlib import Path
from lab.commands import common
from lab.files.text.atomic_write import atomic_folder
common._GRACE_S = 0.2
with common.stopped_by_signals(), atomic_folder(Path(sys.argv[1]), lambda _: True) as work:
    while True:
        try:
            print("ready", flush=True)
            time.sleep(60)
        except SystemExit:
            pass
"""
    with started(program, tmp_path / "results") as process:
        process.terminate()
        process.communicate(timeout=30)
    assert process.returncode == 128 + signal.SIGTERM
    assert names(tmp_path) == []


def test_an_ignored_signal_stays_ignored(tmp_path):
    """As under nohup."""
    program = f"""
import os, signal, sys
sys.path.insert(0, {str(ROOT)!r})
from lab.commands.common import stopped_by_signals
signal.signal(signal.SIGHUP, signal.SIG_IGN)
with stopped_by_signals():
    os.kill(os.getpid(), signal.SIGHUP)
    print("still here")
assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "still here\n", "")


@pytest.mark.parametrize("sent", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_a_stop_in_a_callback_of_llvm_comes_after_it(sent):
    """An exception in there is printed and lost, and LLVM then crashes or compiles what was compiled."""
    program = f"""
import signal, sys, time
sys.path.insert(0, {str(ROOT)!r})
import llvmlite.binding as llvm
from lab.commands.common import stopped_by_signals
signal.signal(signal.{sent}, signal.default_int_handler if {sent!r} == "SIGINT" else signal.SIG_DFL)
llvm.initialize_native_target()
llvm.initialize_native_asmprinter()
module = llvm.parse_assembly("define i32 @one() {{ ret i32 1 }}")
machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
engine = llvm.create_mcjit_compiler(module, machine)
asked = []
def load(module):
    asked.append(module)
    signal.raise_signal(signal.{sent})
engine.set_object_cache(getbuffer_func=load)
with stopped_by_signals():
    try:
        engine.finalize_object()
        time.sleep(30)
    except (SystemExit, KeyboardInterrupt) as stop:
        print(type(stop).__name__, len(asked))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    stop = "KeyboardInterrupt" if sent == "SIGINT" else "StoppedBySignal"
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{stop} 1\n", "")
