"""The command line: help with examples that work; a plain message and an exit status for every mistake."""

from __future__ import annotations

import json
import logging
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import chdir
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import click
import pytest
import yaml
from click.testing import CliRunner, Result

from cli import main
from lab.commands.common import PIPE_CLOSED
from lab.errors import CalibrationError, InputError, RunError
from lab.files.output import saved_traceback
from lab.runs import process
from lab.runs.batch import task as batch
from lab.simulate.scenarios import SCENARIOS
from lab.simulate.write import simulate
from tests.lab.run_folders import write_run
from tests.lab.tables import rows_of
from tests.marks import further_slow
from tests.paths import ROOT

SAMPLE = ROOT / "sample_runs" / "huo2015"
PICTURES = 12  # of each camera of the sample run, enough for every file of a result; `-m slow` takes all 220
PROGRAM = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from cli import main; main(prog_name='beampose')"
EXAMPLE = re.compile(r"^\s*beampose (.+)$", flags=re.MULTILINE)

pytestmark = pytest.mark.skipif(not SAMPLE.is_dir(), reason="a source distribution has no sample runs")


def beampose(cwd: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The program in a process of its own, without a terminal; `python -P` keeps cwd out of its modules.

    Starting a process takes 0.7 s, ten times as long as most commands: most tests use `typed` instead.
    """
    return subprocess.run(
        [sys.executable, "-P", "-c", PROGRAM, *arguments], cwd=cwd, capture_output=True, text=True, check=False
    )


def walk(group: click.Group, before: str = "") -> dict[str, click.Command]:
    """All commands by the words that call them, those of groups too."""
    out: dict[str, click.Command] = {}
    for name, command in group.commands.items():
        out[before + name] = command
        if isinstance(command, click.Group):
            out |= walk(command, f"{before}{name} ")
    return out


COMMANDS = walk(main)


def help_of(name: str) -> str:
    return COMMANDS[name].get_help(click.Context(COMMANDS[name], info_name=name))


def example(name: str) -> list[str]:
    """The arguments of the example in the help of a command."""
    return shlex.split(EXAMPLE.findall(help_of(name))[0])


def typed(*arguments: str | Path, cwd: Path | str = ".") -> Result:
    """The program in this process. A warning that Python would show to the user is an error here."""
    with chdir(cwd), warnings.catch_warnings():
        warnings.simplefilter("error")
        for never_shown in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", never_shown)
        return CliRunner().invoke(main, [str(a) for a in arguments], prog_name="beampose")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working folder for the examples: like a clone, with fewer pictures of the sample run, which is processed."""
    folder = tmp_path_factory.mktemp("desk")
    (folder / "sample_runs").mkdir()
    shortened = {SAMPLE.name: PICTURES, "damaged": 48}
    for path in (ROOT / "sample_runs").iterdir():
        if path.name not in shortened:
            (folder / "sample_runs" / path.name).symlink_to(path)
    for name, count in shortened.items():
        whole = ROOT / "sample_runs" / name
        pictures = [p for camera in ("left", "right") for p in sorted((whole / "frames" / camera).iterdir())[:count]]
        for path in [*(whole / part for part in ("run.yaml", "rig.yaml", "truth")), *pictures]:
            link = folder / path.relative_to(ROOT)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(path)
    done = beampose(folder, *example("run"))
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def works(desk: Path, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command at the desk and returns its stdout; it must succeed, with nothing on stderr (also from C code)."""

    def type_in(*arguments: str) -> str:
        done = typed(*arguments, cwd=desk)
        assert (done.exit_code, done.stderr, capfd.readouterr().err) == (0, "", ""), done.exception
        return done.stdout

    return type_in


def test_the_commands_are_those_of_the_contract():
    words = (
        "run batch detect pick watch record simulate check report study track stereo compare "
        "export view show calibrate refine plan doctor explain init verify schema"
    )
    assert set(main.commands) == set(words.split())
    steps = {"board", "camera", "pair", "screen", "beams", "rig", "check", "convert", "simulate"}
    assert {name for name in COMMANDS if name.startswith("calibrate ")} == {f"calibrate {step}" for step in steps}


@pytest.mark.parametrize("width", [80, 100])
@pytest.mark.parametrize("group", ["", "calibrate"])
def test_the_list_of_commands_cuts_no_description(group, width):
    commands = COMMANDS["calibrate"].commands if group else main.commands
    done = CliRunner().invoke(main, [*group.split(), "--help"], terminal_width=width, prog_name="beampose")
    shown = " ".join(done.stdout.partition("Commands:")[2].split())
    assert "..." not in shown
    for command in commands.values():
        assert " ".join(command.help.split("\n\n")[0].split()).partition(". ")[0].rstrip(".") in shown
    assert max(map(len, done.stdout.splitlines())) <= width


@pytest.mark.parametrize("name", [b"caf\xe9", b"\x1b[2J"])
def test_names_of_folders_that_no_terminal_can_show_are_printed_with_question_marks(name, tmp_path):
    folder = os.fsdecode(os.fsencode(tmp_path) + b"/" + name)
    for arguments in (("schema", "rig", "--out", folder), ("batch", "nothing", "--out", folder)):
        done = typed(*arguments)
        assert done.exception is None or isinstance(done.exception, SystemExit)
        assert f"{tmp_path}/{name[:3].decode() if name[:1] == b'c' else ''}?" in done.stdout
        assert "\x1b" not in done.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_description_and_an_example(name):
    assert len(COMMANDS[name].get_short_help_str(200)) > 20
    assert " ".join(example(name)).startswith(name)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_explained(name):
    unexplained = [
        option.name
        for option in COMMANDS[name].params
        if isinstance(option, click.Option) and not option.help and option.name != "seed"
    ]
    assert unexplained == []


def test_help_names_every_exit_status():
    text = main.get_help(click.Context(main))
    assert [n for n in "01234" if not re.search(rf"\b{n}\b", text)] == []


def test_the_example_of_run_leaves_the_files_of_the_contract(desk):
    out = desk / example("run")[-1]
    tables = [out / f"{name}.csv" for name in ("detections", "spots", "beams", "attitude", "covariance")]
    assert [path for path in (*tables, out / "report.html") if not path.is_file()] == []
    assert isinstance(json.loads((out / "summary.json").read_text()), dict)


@pytest.mark.parametrize(
    "name",
    ["check", "report", "detect", "track point", "doctor", "explain", "verify", "compare", "view", "show", "pick"],
)
def test_the_example_works(works, name):
    assert works(*example(name)).strip()


def test_the_example_of_simulate_makes_a_run_that_check_accepts(works):
    arguments = example("simulate")
    works(*arguments, "--frames", "4")
    works("check", arguments[arguments.index("--out") + 1])


@pytest.mark.slow
def test_the_example_of_study_works(works):
    works(*example("study"))


@pytest.mark.slow
def test_the_examples_work_with_the_whole_sample_run(tmp_path):
    (tmp_path / "sample_runs").symlink_to(ROOT / "sample_runs")
    for name in ("run", "check", "report", "batch", "simulate", "calibrate simulate", "calibrate rig"):
        done = beampose(tmp_path, *example(name))
        assert (done.returncode, done.stderr) == (0, "")


def test_the_examples_of_calibrate_lead_from_a_campaign_to_a_rig_that_is_checked(desk, works):
    works(*example("calibrate simulate"), "--positions", "12")
    for name in ("screen", "beams", "rig"):
        works(*example(f"calibrate {name}"))
    for name in ("points.csv", "survey.csv"):
        (desk / name).write_bytes((desk / "campaign" / name).read_bytes())
    assert works(*example("calibrate check")).startswith("drift check: PASS")
    works("check", "results/rig/rig.yaml")


@pytest.mark.parametrize("name", ["calibrate board", "calibrate convert", "plan", "init", "schema", "record"])
def test_the_example_works_without_preparation(works, name):
    arguments = example(name)
    if name == "plan":
        arguments += ["--range", "yaw_deg=-10:10:3", "--range", "roll_deg=0:0:1", "--range", "x_m=0:0:1"]
    assert works(*arguments).strip()


@pytest.mark.slow
def test_the_example_of_batch_has_a_row_for_every_run_and_an_index(desk, works):
    arguments = example("batch")
    works(*arguments)
    out = desk / arguments[-1]
    assert len(rows_of(out / "batch.csv")) == len(arguments) - 3
    assert (out / "index.html").is_file()


def test_simulate_lists_every_scenario(works):
    listed = works("simulate", "list")
    assert [name for name in SCENARIOS if not re.search(rf"^{name} ", listed, flags=re.MULTILINE)] == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("rnu x", "No such command 'rnu'. Did you mean 'run'?"),
        ("run", "Missing argument 'RUN'"),
        ("run sample_runs/huo2015", "Missing option '--out'"),
        ("run sample_runs/huo2015 --out r --speed 3", "No such option '--speed'"),
        ("run nowhere --out r", "nowhere: expected a run folder, found nothing"),
        ("run sample_runs/README.md --out r", "sample_runs/README.md: expected a run folder, found a file"),
        ("run sample_runs/huo2015 --out sample_runs/huo2015", "something other than earlier results"),
        ("run sample_runs/huo2015 --out r --quiet --verbose", "expected --verbose or --quiet, got both"),
        ("run sample_runs/huo2015 --out r --set r1_px", "expected NAME=VALUE, got 'r1_px'"),
        ("run sample_runs/huo2015 --out r --set r1_pz=3", "unknown key 'r1_pz'"),
        ("batch --out r", "Missing argument 'RUN...'"),
        ("detect --out r", "Missing argument 'IMAGES_OR_VIDEO...'"),
        ("detect nowhere --out r", "nowhere: expected a picture"),
        ("detect sample_runs/README.md --out r", "sample_runs/README.md: expected a picture"),
        ("detect sample_runs/huo2015/frames --out r", "its folders left, right do: name one of them"),
        ("detect sample_runs/huo2015/frames/left --out r --every 0", "0 is not in the range"),
        ("detect sample_runs/huo2015/frames/left --out r --set r1_px=3", "expected a parameter of detection"),
        ("pick nowhere --out r", "nowhere: expected a picture"),
        ("pick sample_runs/damaged/frames/left --out r", "expected at most 40 pictures"),
        (
            "pick sample_runs/huo2015/frames/left/000000.png --out r --names nowhere.csv",
            "nowhere.csv: expected a table",
        ),
        ("record --camera left --out r", "expected NAME=SOURCE such as left=0, got 'left'"),
        ("record --camera left=nothing --out r", "expected a camera that OpenCV can open, got 'nothing'"),
        ("watch sample_runs/huo2015 --out r --page here", "--page: expected PORT or HOST:PORT"),
        ("init r --own", "--own asks questions, which need a terminal"),
        ("watch nowhere --out r", "nowhere: expected a run folder, found nothing"),
        ("watch sample_runs/four-skew-beams --out r", "expected a folder of pictures or a device to watch"),
        ("watch sample_runs/huo2015 --out r --udp here", "--udp: expected HOST:PORT"),
        ("simulate clean", "Missing option '--out'"),
        ("simulate nothing --out r", "got 'nothing'"),
        ("simulate clean --out r --frames 0", "0 is not in the range"),
        ("report sample_runs", "found no summary.json"),
        ("schema", "expected a kind of file (rig, run, camera, board, calibration, screens) or --out FOLDER"),
        ("schema riga", "'riga' is not one of"),
        ("verify sample_runs", "found no summary.json"),
        ("explain BP-V99", "expected a code such as BP-V03, got 'BP-V99'"),
        ("init sample_runs --beams 3", "expected a new or empty folder, found files"),
        ("init r --beams 2 --screens 1", "expected at least 3 for 1 screen, got 2"),
        ("init r --cameras 1 --screens 2", "expected at least one per screen (2), got 1"),
        ("init r --picture large", "expected width and height in px such as 1920x1080, got 'large'"),
        ("compare sample_runs --out r", "expected a second result folder or --reference"),
        ("compare sample_runs sample_runs --out r", "found no summary.json"),
        ("study nothing --out r", "'nothing' is not"),
        ("track point nowhere --out r", "nowhere: expected a picture"),
        ("track point sample_runs/README.md --out r", "sample_runs/README.md: expected a picture"),
        ("track point sample_runs/huo2015/frames/left --out r --detector red", "'red' is not one of"),
        ("calibrate sreen x --out r", "No such command 'sreen'. Did you mean 'screen'?"),
        ("calibrate board chess:9x6 --out r", "chess"),
        ("calibrate screen nowhere.yaml --out r", "nowhere.yaml: expected a file, found none"),
        ("calibrate beams nowhere.yaml --out r", "nowhere.yaml: expected a file, found none"),
        ("calibrate rig sample_runs/huo2015/rig.yaml --out r", "schema: expected 'beampose/calibration/1'"),
        ("calibrate check sample_runs/huo2015/rig.yaml --out r", "either known points (--points) or a static run"),
        ("calibrate convert sample_runs/README.md r --to ros", "sample_runs/README.md"),
        ("plan sample_runs/huo2015/rig.yaml --out r --range yaw=1:2:3", "did you mean 'yaw_deg'?"),
        ("plan sample_runs/huo2015/rig.yaml --out r --range yaw_deg=1", "expected NAME=FIRST:LAST:COUNT"),
        ("plan sample_runs/huo2015/rig.yaml --out r --expect dot_pixels=1", "unknown key 'dot_pixels'"),
    ],
)
def test_a_mistake_is_one_or_two_plain_lines_and_exit_status_2(desk, arguments, words):
    done = typed(*arguments.split(), cwd=desk)
    assert done.exit_code == 2
    assert words in done.stderr
    assert 1 <= len(done.stderr.splitlines()) <= 2
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert not (desk / "r").exists()


def test_a_path_that_check_does_not_find_is_exit_status_2(desk):
    done = typed("check", "nowhere", cwd=desk)
    assert done.exit_code == 2
    assert "nowhere: expected a file, found none" in done.output


def test_no_command_at_all_shows_the_help(desk):
    done = beampose(desk)
    assert done.returncode == 2
    assert "Commands:" in done.stdout + done.stderr


def test_the_version_is_that_of_the_installed_package():
    try:
        installed = version("beampose")
    except PackageNotFoundError:
        pytest.skip("beampose is not installed: make setup")
    assert installed in typed("--version").stdout


# -- in this process: errors inside a command --------------------------------------------------------------


def points_run(folder: Path) -> Path:
    return simulate("smooth", folder, seed=5, frames=5, points=True)


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (RunError("frames/left: the disk went away"), 1, "beampose: frames/left: the disk went away"),
        (InputError("rig.yaml: cameras: expected some"), 2, "beampose: rig.yaml: cameras: expected some"),
        (CalibrationError("rig.yaml: out of date"), 3, "beampose: rig.yaml: out of date"),
        (
            OSError(28, "No space left on device", "out/spots.csv"),
            1,
            "beampose: out/spots.csv: No space left on device",
        ),
        (OSError("odd"), 1, "beampose: odd"),
        (MemoryError(), 1, "beampose: out of memory"),
        (KeyboardInterrupt(), 1, "beampose: stopped"),
    ],
)
def test_every_kind_of_error_is_a_plain_line_with_its_exit_status(tmp_path, monkeypatch, error, status, words):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(process, "process_run", fail)
    done = typed("run", tmp_path, "--out", tmp_path / "out")
    assert done.exit_code == status
    assert done.stderr.strip() == words
    assert done.stdout.strip() == ""


@pytest.mark.parametrize("error", [RuntimeError("an index\n\x1b[31mis wrong"), ZeroDivisionError(), EOFError("cut")])
def test_an_unforeseen_error_is_one_line_with_the_place_of_its_traceback(tmp_path, monkeypatch, error):
    def fail(*_, **__):
        raise error

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(process, "process_run", fail)
    for number in (1, 2):
        done = typed("run", tmp_path, "--out", tmp_path / "out")
        assert (done.exit_code, done.stdout) == (1, "")
        (line,) = done.stderr.splitlines()
        words = " ".join(f"{type(error).__name__}: {error}".replace("\x1b", " ").split()).rstrip(": ")
        place = re.fullmatch(
            rf"beampose: unexpected error: {re.escape(words)}; the traceback is in (.*); please report it", line
        )
        assert place is not None, line
        text = Path(place[1]).read_text("utf-8")
        assert "in fail" in text
        assert "command: " in text
        assert "numpy " in text
        assert len(list((tmp_path / "cache").rglob("*.txt"))) == number  # an earlier one is kept


def test_a_traceback_that_cannot_be_saved_is_shown(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("an index")

    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(saved_traceback.tempfile, "mkstemp", lambda **_: fail_to_write())
    monkeypatch.setattr(process, "process_run", fail)
    done = typed("run", tmp_path, "--out", tmp_path / "out")
    assert done.exit_code == 1
    assert "beampose: unexpected error: RuntimeError: an index; please report it with this traceback:" in done.stderr
    assert "in fail" in done.stderr


def fail_to_write() -> None:
    raise OSError(28, "No space left on device")


def hears_signals() -> None:
    """In the new process: `nohup make test` ignores SIGHUP, and so would the program, as it should."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals of POSIX")
@pytest.mark.parametrize("sent", further_slow(["SIGTERM", "SIGHUP"]))
def test_a_run_that_is_stopped_by_a_signal_leaves_nothing_and_says_so(tmp_path, sent):
    simulate("smooth", tmp_path / "run", seed=5, frames=400, points=True)
    command = [sys.executable, "-P", "-c", PROGRAM, "run", "run", "--out", "out"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=tmp_path, preexec_fn=hears_signals, **pipes) as running:
        until = time.monotonic() + 120
        while time.monotonic() < until and not list(tmp_path.glob(".out.part-*/attitude.csv")):
            time.sleep(0.01)
        second = typed("run", tmp_path / "run", "--out", tmp_path / "out")
        running.send_signal(getattr(signal, sent))
        out, errors = running.communicate(timeout=60)
    assert second.exit_code == 2
    assert f"in use by process {running.pid} on" in second.stderr
    assert (running.returncode, out, errors) == (128 + getattr(signal, sent), "", f"beampose: stopped by {sent}\n")
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals of POSIX")
def test_a_signal_within_a_compiled_function_is_no_unexpected_error(tmp_path):
    """numba turns an exception that a signal raises within its code into a SystemError."""
    program = (
        "import os, signal, lab.runs.input_check as check\n"
        "def fails(*_):\n"
        "    try:\n"
        "        os.kill(os.getpid(), signal.SIGHUP)\n"
        "    except BaseException as error:\n"
        "        raise SystemError('returned a result with an exception set') from error\n"
        "check.check = fails\n" + PROGRAM
    )
    (tmp_path / "rig.yaml").write_text("")
    command = [sys.executable, "-P", "-c", program, "check", "rig.yaml"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, preexec_fn=hears_signals)
    assert (done.returncode, done.stderr) == (129, "beampose: stopped by SIGHUP\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_an_error_message_that_cannot_be_written_keeps_its_exit_status(tmp_path):
    program = shlex.join([sys.executable, "-P", "-c", PROGRAM, "explain", "BP-V99"])
    assert subprocess.run(["sh", "-c", f"{program} 2>/dev/full"], cwd=tmp_path, capture_output=True).returncode == 2
    program = shlex.join([sys.executable, "-P", "-c", PROGRAM, "check", "nowhere"])
    assert subprocess.run(["sh", "-c", f"{program} 2>/dev/full"], cwd=tmp_path, capture_output=True).returncode == 2


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes")
@pytest.mark.parametrize("name", further_slow(["frames/000001.png", "film.mp4"]))
def test_a_named_pipe_is_no_picture_and_nothing_waits_for_it(tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(path)
    program = [sys.executable, "-P", "-c", PROGRAM, "detect", name.split("/")[0], "--out", "out"]
    done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert 1 <= len(done.stderr.splitlines()) <= 2
    assert "unexpected" not in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == [name.split("/")[0]]


def test_a_failed_quality_gate_is_exit_status_4_in_summary_and_report(tmp_path):
    done = typed("run", write_run(tmp_path / "grey"), "--out", tmp_path / "out")
    assert done.exit_code == 4
    assert done.stdout.startswith("small: FAIL: 0 of 5 frames measured (the vehicle was never found")
    assert done.stderr == ""
    assert json.loads((tmp_path / "out/summary.json").read_text())["verdict"]["exit_status"] == 4
    assert "never found" in (tmp_path / "out/report.html").read_text("utf-8")


def test_a_run_that_passes_is_exit_status_0_and_one_line(tmp_path):
    done = typed("run", points_run(tmp_path / "run"), "--out", tmp_path / "out")
    assert (done.exit_code, done.stderr) == (0, "")
    (line,) = done.stdout.splitlines()
    assert line.startswith("smooth-5: PASS: 5 of 5 frames measured")
    assert line.endswith(f"-> {tmp_path / 'out'}")


def test_a_misspelt_parameter_gets_a_suggestion(tmp_path):
    done = typed("run", points_run(tmp_path / "run"), "--out", tmp_path / "out", "--set", "omega_1=0.5")
    assert done.exit_code == 2
    assert "unknown key 'omega_1'" in done.stderr
    assert "did you mean 'omega1'" in done.stderr
    assert not (tmp_path / "out").exists()


def test_parameters_are_read_as_yaml_and_reach_the_run(tmp_path):
    settings = ("r1_px=12", "detect.threshold_sigma=5.5", "curve_switch=false", "g1_scale=paper")
    options = [o for s in settings for o in ("--set", s)]
    done = typed("run", points_run(tmp_path / "run"), "--out", tmp_path / "out", *options)
    assert done.exit_code == 0, done.stderr
    tracker = json.loads((tmp_path / "out/summary.json").read_text())["parameters"]["tracker"]
    assert (tracker["r1_px"], tracker["detect"]["threshold_sigma"]) == (12, 5.5)
    assert (tracker["curve_switch"], tracker["g1_scale"]) == (False, "paper")


def test_causal_skips_the_smoothing_pass(tmp_path):
    folder = points_run(tmp_path / "run")
    assert typed("run", folder, "--out", tmp_path / "one", "--causal").exit_code == 0
    assert typed("batch", folder, "--out", tmp_path / "many", "--causal").exit_code == 0
    for out in (tmp_path / "one", tmp_path / "many/run"):
        assert json.loads((out / "summary.json").read_text())["attitude"] == "causal"
        assert not (out / "attitude_causal.csv").exists()


def test_a_run_without_a_prior_is_processed_and_a_symmetric_rig_fails(tmp_path):
    """The fan of equal angles is symmetric under half a turn: FAIL, and the check names the remedy."""
    folder = points_run(tmp_path / "run")
    content = yaml.safe_load((folder / "run.yaml").read_text())
    del content["prior"]
    (folder / "run.yaml").write_text(yaml.safe_dump(content))
    done = typed("run", folder, "--out", tmp_path / "out")
    assert done.exit_code == 4
    assert "the spots fit more than one pose" in done.stdout
    assert json.loads((tmp_path / "out/summary.json").read_text())["parameters"]["prior"] is None
    checked = typed("check", folder)
    assert checked.exit_code == 0
    assert "a rotation by 180 deg maps the beams onto each other: the first labels remain ambiguous" in checked.stdout
    assert "Add prior: {position_m:" in checked.stdout


def test_a_batch_reports_every_run_and_ends_with_the_worst_status(tmp_path):
    """Three batches into one folder, of which the later ones skip what is done."""
    good, grey, out = points_run(tmp_path / "good"), write_run(tmp_path / "grey"), tmp_path / "out"
    for runs, status in (([good], 0), ([good, grey], 4), ([grey, tmp_path / "nowhere", good], 1)):
        done = typed("batch", *runs, "--out", out)
        assert done.exit_code == status
        assert [Path(r["run"]) for r in rows_of(out / "batch.csv")] == runs
        first_words = [line.split(":")[0] for line in done.stdout.splitlines()]
        assert [word for word in first_words if word != "done already"] == [*(r.name for r in runs), "table", "index"]
    assert "nowhere: expected a run folder, found nothing" in done.output
    assert (out / "good/attitude.csv").is_file()


def test_a_misspelt_parameter_stops_a_batch_before_its_first_run(tmp_path):
    done = typed("batch", points_run(tmp_path / "a"), "--out", tmp_path / "out", "--set", "r1_pz=3")
    assert done.exit_code == 2
    assert "did you mean 'r1_px'" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_stopped_batch_reports_it(tmp_path, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(batch, "process_run", stop)
    done = typed("batch", points_run(tmp_path / "a"), "--out", tmp_path / "out")
    assert done.exit_code == 1
    assert done.stderr.strip() == "beampose: stopped"


def test_ctrl_c_ends_a_watched_recording_and_writes_its_results(tmp_path):
    simulate("smooth", tmp_path / "run", seed=5, frames=8, scale=0.25)
    command = [sys.executable, "-P", "-c", PROGRAM, "watch", "run", "--out", "out"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as watching:
        until, table = time.monotonic() + 60, tmp_path / "out/attitude_live.csv"
        while time.monotonic() < until and not (table.is_file() and len(table.read_text().splitlines()) == 9):
            time.sleep(0.05)
        watching.send_signal(signal.SIGINT)
        out, errors = watching.communicate(timeout=60)
    assert (watching.returncode, errors) == (0, "")
    assert out.startswith("smooth-5: PASS: 8 of 8 frames measured")
    assert json.loads((tmp_path / "out/summary.json").read_text())["notes"] == [
        "left: 8 pictures existed before the watch began",
        "right: 8 pictures existed before the watch began",
    ]


def test_a_foreign_folder_is_not_replaced(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/chapter.tex").write_text("years")
    done = typed("run", points_run(tmp_path / "run"), "--out", tmp_path / "thesis")
    assert done.exit_code == 2
    assert "something other than earlier results" in done.stderr
    assert (tmp_path / "thesis/chapter.tex").read_text() == "years"


@pytest.mark.parametrize(
    "arguments", further_slow([(("explain",),), (("check", str(SAMPLE / "rig.yaml")),), (("--help",),)])
)
def test_output_into_a_closed_pipe_ends_quietly_with_the_status_of_a_closed_pipe(arguments, tmp_path):
    command = [sys.executable, "-P", "-c", PROGRAM, *arguments]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as started:
        started.stdout.close()
        errors = started.stderr.read()
    assert (started.returncode, errors) == (PIPE_CLOSED, b"")


@pytest.mark.parametrize("arguments", further_slow([(("rnu",),), (("explain", "BP-V99"),)]))
def test_an_error_message_into_a_closed_pipe_ends_quietly_too(arguments, tmp_path):
    command = [sys.executable, "-P", "-c", PROGRAM, *arguments]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as started:
        started.stderr.close()
        started.stdout.read()
    assert started.returncode == PIPE_CLOSED


@pytest.mark.parametrize(
    ("closed", "arguments", "status"),
    further_slow([
        ("2>&-", ("explain", "BP-V99"), 2), ("<&- >&- 2>&-", ("check", str(SAMPLE / "rig.yaml")), 0),
        ("2>&-", ("explain", "BP-V03"), 0), (">&-", ("explain", "BP-V03"), 0), (">&- 2>&-", ("check", "nowhere"), 2),
    ], fast=2),
)  # fmt: skip
def test_closed_standard_streams_change_no_exit_status(closed, arguments, status, tmp_path):
    program = shlex.join([sys.executable, "-P", "-c", PROGRAM, *arguments])
    done = subprocess.run(["sh", "-c", f"{program} {closed}"], cwd=tmp_path, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (status, b"")


def test_a_setting_is_read_as_in_a_file(tmp_path):
    """YAML 1.2, as in run.yaml: 1e-3 is a number, 1:30 is a word."""
    folder = points_run(tmp_path / "run")
    done = typed("run", folder, "--out", tmp_path / "out", "--set", "r1_px=1e1")
    assert done.exit_code == 0, done.stderr
    assert json.loads((tmp_path / "out/summary.json").read_text())["parameters"]["tracker"]["r1_px"] == 10
    done = typed("run", folder, "--out", tmp_path / "out", "--set", "r1_px=1:30")
    assert done.exit_code == 2
    assert "r1_px: expected a finite number, got '1:30'" in done.stderr


@pytest.mark.parametrize(("terminal", "words"), [(True, "beampose: compiling\n"), (False, "")])
def test_log_messages_are_shown_on_a_terminal_only(monkeypatch, capsys, terminal, words):
    logger = logging.getLogger("beampose")
    monkeypatch.setattr(logger, "handlers", [])
    monkeypatch.setattr(logger, "level", logging.NOTSET)
    logger.manager._clear_cache()
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    with pytest.raises(SystemExit):
        main(["--help"])
    logger.info("compiling")
    logger.manager._clear_cache()
    assert capsys.readouterr().err == words
