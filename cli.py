"""The command line: reads arguments, calls one function of lab/, prints a line. All of it can be done from Python."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from lab.errors import BeamposeError, InputError

_FOLDER = click.Path(file_okay=False, path_type=Path)
_ANY_PATH = click.Path(path_type=Path)


class _ToStderr(logging.Handler):
    """What the floors below tell whoever waits, such as that they compile: a line on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        print(f"beampose: {record.getMessage()}", file=sys.stderr)  # not by click, which writes into a progress bar


def _listen_on_a_terminal() -> None:
    """On a terminal only, as the progress bar: elsewhere nobody waits, and a word on stderr means trouble."""
    logger = logging.getLogger("beampose")
    if sys.stderr.isatty() and not logger.handlers:
        logger.addHandler(_ToStderr())
        logger.setLevel(logging.INFO)


class _Commands(click.Group):
    """Turns the lab's own exceptions and click's into a plain line or two and an exit status, in one place."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        _listen_on_a_terminal()
        try:
            sys.exit(super().main(*args, **{**kwargs, "standalone_mode": False}))
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(error.exit_code)
        except click.UsageError as error:
            click.echo(f"beampose: {error.format_message()}", err=True)
            if error.ctx:
                click.echo(f"Help: {error.ctx.command_path} --help", err=True)
            sys.exit(error.exit_code)
        except click.Abort:
            click.echo("beampose: stopped", err=True)
            sys.exit(1)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except BeamposeError as error:
            click.echo(f"beampose: {error}", err=True)
            sys.exit(error.exit_status)
        except MemoryError:
            click.echo("beampose: out of memory", err=True)
            sys.exit(1)
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            click.echo(f"beampose: {where}{error.strerror or error}", err=True)
            sys.exit(1)


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="beampose")
def main() -> None:
    """Attitude and position of a vehicle model from the pictures of its laser spots.

    Exit status: 0 all done; 1 some run could not be processed; 2 the command, a file or a configuration is wrong;
    3 the calibration is unusable; 4 processed, but a quality gate failed.
    """


def _settings(ctx: click.Context, parameter: click.Parameter, values: Sequence[str]) -> dict[str, Any]:
    """--set name=value, the value read as YAML."""
    import yaml

    out: dict[str, Any] = {}
    for text in values:
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise click.BadParameter(f"expected NAME=VALUE, got {text!r}", ctx=ctx, param=parameter)
        try:
            out[name.strip()] = yaml.safe_load(value)
        except yaml.YAMLError:
            raise click.BadParameter(f"{name}: cannot read the value {value!r}", ctx=ctx, param=parameter) from None
    return out


_set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="NAME=VALUE",
    callback=_settings,
    help="A tracker parameter in place of run.yaml's, e.g. --set r1_px=12 or --set detect.threshold_sigma=5.",
)


@contextmanager
def _progress(name: str) -> Iterator[Callable[..., None] | None]:
    """A bar on a terminal, nothing elsewhere. It is told what is done, of how much, and in which stage."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    parts = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*parts, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=None)

        def tell(done: int, total: int | None, stage: str = "") -> None:
            bar.update(task, completed=done, total=total, description=f"{name}: {stage}" if stage else name)

        yield tell


_causal_option = click.option(
    "--causal", is_flag=True, help="No second pass: attitude.csv says what was known at each instant."
)


@main.command()
@click.argument("run_folder", metavar="RUN", type=_ANY_PATH)
@click.option("--out", required=True, type=_FOLDER, help="Where the results go; earlier results there are replaced.")
@_causal_option
@_set_option
def run(run_folder: Path, out: Path, causal: bool, settings: dict[str, Any]) -> None:
    """Process one run folder: tables, summary.json and report.html.

    \b
    Example:
        beampose run sample_runs/huo2015 --out results/huo2015
    """
    from lab.runs.process import process_run

    with _progress(run_folder.name) as progress:
        outcome = process_run(run_folder, out, overrides=settings, causal=causal, progress=progress)
    click.echo(outcome.line())
    sys.exit(outcome.exit_status)


@main.command()
@click.argument("run_folders", metavar="RUN...", nargs=-1, required=True, type=_ANY_PATH)
@click.option("--out", required=True, type=_FOLDER, help="Gets one folder per run, batch.csv and index.html.")
@_causal_option
@_set_option
def batch(run_folders: tuple[Path, ...], out: Path, causal: bool, settings: dict[str, Any]) -> None:
    """Process many run folders; one that fails costs only itself.

    \b
    Example:
        beampose batch sample_runs/huo2015 sample_runs/damaged --out results/all
    """
    from lab.runs.batch import process_batch

    outcome = process_batch(run_folders, out, overrides=settings, causal=causal, report=click.echo)
    click.echo(f"table: {outcome.table}")
    click.echo(f"index: {outcome.index}")
    sys.exit(outcome.exit_status)


@main.command()
@click.argument("pictures", metavar="IMAGES_OR_VIDEO...", nargs=-1, required=True, type=_ANY_PATH)
@click.option("--out", required=True, type=_FOLDER, help="Gets detections.csv, contact-sheet.png and report.html.")
@click.option("--camera", help="The camera's name in the table; default: that of the folder or file.")
@click.option(
    "--every", default=1, show_default=True, type=click.IntRange(min=1), help="Look at each N-th picture only."
)
@click.option("--limit", type=click.IntRange(min=1), help="Look at so many pictures at most.")
@_set_option
def detect(
    pictures: tuple[Path, ...],
    out: Path,
    camera: str | None,
    every: int,
    limit: int | None,
    settings: dict[str, Any],
) -> None:
    """Find the spots in pictures or a video, without a rig: table, contact sheet, noise, sizes and signal.

    A folder of pictures, picture files, a pattern such as 'shots/*.png', or one video.

    \b
    Example:
        beampose detect sample_runs/huo2015/frames/left --every 10 --out results/spots
    """
    from lab.detect.detect import DetectOptions, detect_pictures

    options = DetectOptions(camera, every, limit, settings)
    with _progress("pictures") as progress:
        outcome = detect_pictures(list(pictures), out, options, progress)
    _concluded(outcome)


@main.command()
@click.argument("run_folder", metavar="RUN", type=_ANY_PATH)
@click.option("--out", required=True, type=_FOLDER, help="Gets attitude_live.csv at once, and the results at the end.")
@click.option("--udp", metavar="HOST:PORT", help="Also send a line of JSON per frame there.")
@click.option(
    "--idle",
    default=10.0,
    show_default=True,
    type=click.FloatRange(min=0.1),
    help="So many seconds without a new picture end the recording.",
)
@click.option(
    "--timeout",
    default=0.25,
    show_default=True,
    type=click.FloatRange(min=0.001),
    help="So many seconds a frame waits for a camera that does not give it.",
)
@click.option(
    "--reprocess", is_flag=True, help="At the end, make the results from the finished folders, as `run` does."
)
@_set_option
def watch(
    run_folder: Path,
    out: Path,
    udp: str | None,
    idle: float,
    timeout: float,
    reprocess: bool,
    settings: dict[str, Any],
) -> None:
    """Follow a run while it is recorded: the pose of every frame as it arrives.

    RUN is a run folder whose frame folders are being filled, or whose run.yaml names a `device` for a camera (a number
    or name that OpenCV opens). Each pose is appended to attitude_live.csv in the folder --out. When the recording
    ends (--idle, Ctrl-C, the device's end), the results of `run` are made of what was received.

    \b
    Example:
        beampose watch runs/today --out results/today --udp 127.0.0.1:5005
    """
    from lab.watch.live_frames import WatchOptions
    from lab.watch.watch import stopped_by_ctrl_c, watch_run

    with _progress(run_folder.name) as progress, stopped_by_ctrl_c() as stop:
        outcome = watch_run(
            run_folder,
            out,
            udp=udp,
            reprocess=reprocess,
            options=WatchOptions(idle, timeout),
            overrides=settings,
            progress=progress,
            stop=stop,
        )
    _concluded(outcome)


@main.command()
@click.argument("scenario")
@click.option("--out", type=_FOLDER, help="The run folder to write; it must not exist yet.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="The same seed, the same bytes.")
@click.option("--frames", type=click.IntRange(min=1), help="How many; default: the scenario's own number.")
@click.option("--video", is_flag=True, help="One lossless video per camera in place of PNG files.")
@click.option("--points", is_flag=True, help="No pictures: a detections.csv with --noise-px.")
@click.option(
    "--noise-px", default=0.1, show_default=True, type=click.FloatRange(min=0), help="With --points: 1 sigma."
)
@click.option("--clutter", type=click.FloatRange(0, 1), help="Probability of a false spot near each spot.")
@click.option("--light", help="A preset of light and sensor in place of the scenario's.")
@click.option(
    "--scale", default=1.0, show_default=True, type=click.FloatRange(0.1, 1), help="0.5: pictures half as wide."
)
@click.option("--rig", type=_ANY_PATH, help="A rig.yaml in place of the scenario's rig: as it truly is.")
@click.option("--known-rig", type=_ANY_PATH, help="The rig.yaml that the run gets, such as a calibration of that rig.")
def simulate(
    scenario: str,
    out: Path | None,
    seed: int,
    frames: int | None,
    video: bool,
    points: bool,
    noise_px: float,
    clutter: float | None,
    light: str | None,
    scale: float,
    rig: Path | None,
    known_rig: Path | None,
) -> None:
    """Write a simulated recording with its truth; SCENARIO `list` names them all.

    \b
    Example:
        beampose simulate sharp-turns --frames 50 --out runs/sharp-turns
    """
    from lab.simulate.scenarios import LIGHTS, SCENARIOS
    from lab.simulate.write import simulate as write_run

    if scenario == "list":
        for one in SCENARIOS.values():
            click.echo(f"{one.name:24s}{one.summary}")
        click.echo(f"{'lights:':24s}{', '.join(LIGHTS)}")
        return
    if out is None:
        raise click.UsageError("Missing option '--out'.")
    with _progress(scenario) as progress:
        folder = write_run(
            scenario,
            out,
            seed=seed,
            frames=frames,
            video=video,
            detections_only=points,
            light=light,
            clutter=clutter,
            noise_px=noise_px,
            picture_scale=scale,
            rig=rig,
            known_rig=known_rig,
            progress=None if progress is None else lambda done, total: progress(done, total),
        )
    click.echo(f"run: {folder}")


@main.command()
@click.argument("path", type=_ANY_PATH)
def check(path: Path) -> None:
    """Check a rig.yaml or a run folder, and say what the rig can see.

    \b
    Example:
        beampose check sample_runs/huo2015
    """
    from lab.runs.input_check.check import check as check_path

    result = check_path(path)
    for line in result.lines:
        click.echo(line)
    sys.exit(result.exit_status)


@main.command()
@click.argument("results", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--run", "run_folder", type=_FOLDER, help="The run folder, where it has moved since.")
def report(results: Path, run_folder: Path | None) -> None:
    """Make report.html of a result folder anew.

    \b
    Example:
        beampose report results/huo2015
    """
    from lab.report.run.page import write_report
    from lab.runs.process import are_results

    if not are_results(results):
        raise InputError(f"{results}: expected a folder that `beampose run` wrote, found no summary.json of one")
    click.echo(f"report: {write_report(results, run_folder)}")


@main.command()
@click.argument("name", type=click.Choice(["huo2015"]))
@click.option("--out", required=True, type=_FOLDER, help="Gets report.html, figures.csv and the run.")
@click.option("--seed", default=1, show_default=True, type=click.IntRange(min=0))
def study(name: str, out: Path, seed: int) -> None:
    """Repeat a published experiment beside its printed figures.

    \b
    Example:
        beampose study huo2015 --out results/study
    """
    from lab.study.studies import study_huo2015

    outcome = study_huo2015(out, seed=seed)
    for line in outcome.lines:
        click.echo(line)
    click.echo(f"table: {outcome.table}")
    click.echo(f"report: {outcome.report}")


def _concluded(outcome: Any) -> None:
    """What came out, in a line or more, and its exit status."""
    click.echo(outcome.line())
    sys.exit(outcome.exit_status)


@main.group(cls=_Commands)
def calibrate() -> None:
    """Calibrate cameras, screens and beams, and check that they still hold.

    Each step writes its numbers with their covariance, and a report that ends in PASS, WARN or FAIL with the reason and
    the remedy. Exit status: 0 for PASS and WARN, 3 for FAIL.

    \b
    Example:
        beampose calibrate board chessboard:9x6:25mm --out board
    """


@calibrate.command()
@click.argument("board")
@click.option("--out", required=True, type=_ANY_PATH, help="A folder, or one file ending in .pdf, .svg or .png.")
@click.option("--page", default="A4", show_default=True, help="A4, A3 ... or fit: as large as the board.")
@click.option("--dpi", default=300.0, show_default=True, type=click.FloatRange(50, 2400), help="Of the PNG.")
def board(board: str, out: Path, page: str, dpi: float) -> None:
    """Write a printable board to exact scale, and board.yaml.

    BOARD: chessboard:9x6:25mm (inner corners), circles:10x10:12mm, acircles:4x11:20mm,
    charuco:5x7:40mm:20mm:DICT_4X4_50 (with :inverted for white on black), or a board.yaml.

    \b
    Example:
        beampose calibrate board charuco:5x7:36mm:18mm:DICT_4X4_50 --out board
    """
    from lab.calibrate.board.board import write_board

    _concluded(write_board(board, out, page=page, dpi=dpi))


@calibrate.command()
@click.argument("photos", nargs=-1, required=True, type=_ANY_PATH)
@click.option("--board", required=True, help="What is on the photos: as for `calibrate board`, or a board.yaml.")
@click.option("--out", required=True, type=_FOLDER, help="Gets camera.yaml, corners.csv and report.html.")
@click.option("--name", help="The camera's name; default: that of the folder --out.")
@click.option(
    "--distance-m", type=click.FloatRange(min=0, min_open=True), help="To the screen: figures in mm hold there."
)
@click.option("--lens", default="auto", show_default=True, help="0, 4, 5, 8, 12, fisheye; auto: by views held out.")
@click.option("--warp", default="auto", show_default=True, help="auto, on, off: is the board's bend solved for.")
@click.option(
    "--stretch", default="auto", show_default=True, help="auto, on, off: is the board's scale x to y solved for."
)
@click.option("--valid-days", default=365, show_default=True, type=click.IntRange(min=1), help="How long it holds.")
def camera(
    photos: tuple[Path, ...],
    board: str,
    out: Path,
    name: str | None,
    distance_m: float | None,
    lens: str,
    warp: str,
    stretch: str,
    valid_days: int,
) -> None:
    """Calibrate a camera's lens from photos of a board: files, folders, patterns or a video.

    \b
    Example:
        beampose calibrate camera campaign/photos/left --board campaign/board.yaml --out results/left
    """
    from lab.calibrate.camera.camera import CameraOptions, calibrate_camera

    options = CameraOptions(
        name=name or out.resolve().name,
        distance_m=distance_m,
        lens=lens,
        warp=warp,
        stretch=stretch,
        valid_days=valid_days,
    )
    with _progress("photos") as progress:
        tell = None if progress is None else lambda done, total, _: progress(done, total)
        outcome = calibrate_camera(photos, board, out, options, progress=tell)
    _concluded(outcome)


_project = click.argument("project", type=_ANY_PATH)


@calibrate.command()
@_project
@click.option("--out", required=True, type=_FOLDER, help="Gets screens.yaml, tables and report.html.")
def screen(project: Path, out: Path) -> None:
    """Find where screens and cameras stand: surveyed dots, boards, scanned clouds. PROJECT: a calibration.yaml.

    \b
    Example:
        beampose calibrate screen campaign/calibration.yaml --out results/screens
    """
    from lab.calibrate.screens.screen import calibrate_screen

    _concluded(calibrate_screen(project, out))


@calibrate.command()
@_project
@click.option("--out", required=True, type=_FOLDER, help="Gets rig.yaml, beams.csv, tables and report.html.")
@click.option("--rig", type=_ANY_PATH, help="With cameras and screens as calibrated; default: rig.yaml by the project.")
def beams(project: Path, out: Path, rig: Path | None) -> None:
    """Find the beams in the vehicle from recordings at known (or unknown) stand positions.

    \b
    Example:
        beampose calibrate beams campaign/calibration.yaml --rig results/screens/rig.yaml --out results/beams
    """
    from lab.calibrate.beams.beams import calibrate_beams

    _concluded(calibrate_beams(project, out, rig))


@calibrate.command()
@_project
@click.option("--out", required=True, type=_FOLDER, help="Gets rig.yaml with its joint covariance, and report.html.")
def rig(project: Path, out: Path) -> None:
    """Solve cameras, screens and beams together, and write the rig.yaml that runs use.

    \b
    Example:
        beampose calibrate rig campaign/calibration.yaml --out results/rig
    """
    from lab.calibrate.rig.rig import calibrate_rig

    _concluded(calibrate_rig(project, out))


@calibrate.command("check")
@click.argument("rig", type=_ANY_PATH)
@click.option("--out", required=True, type=_FOLDER, help="Gets drift.csv and report.html.")
@click.option("--points", type=_ANY_PATH, help="Known points: camera,point,u_px,v_px[,sigma_px].")
@click.option("--survey", type=_ANY_PATH, help="Where they are: point,x_m,y_m,z_m[,sigmas].")
@click.option(
    "--run", "run_folder", type=_ANY_PATH, help="Or a recording (or its results) of a vehicle that stands still ..."
)
@click.option("--pose", type=_ANY_PATH, help="... at a pose that is known: a CSV like truth/pose.csv.")
@click.option("--history", type=_ANY_PATH, help="A CSV that this check is added to, for the trend.")
def daily(
    rig: Path,
    out: Path,
    points: Path | None,
    survey: Path | None,
    run_folder: Path | None,
    pose: Path | None,
    history: Path | None,
) -> None:
    """Does the stored calibration still hold today? Drift per camera in px and mm; exit status 3: do not use it.

    \b
    Example:
        beampose calibrate check results/rig/rig.yaml --points points.csv --survey survey.csv --out results/today
    """
    from lab.calibrate.drift_check.drift_check import check_drift

    _concluded(check_drift(rig, out, points, run_folder, survey=survey, pose=pose, history=history))


@calibrate.command()
@click.argument("source", type=_ANY_PATH)
@click.argument("destination", type=_ANY_PATH)
@click.option("--from", "origin", help="The source's format, where its content does not tell.")
@click.option("--to", "target", help="opencv, kalibr, ros, colmap, mrcal or beampose, where the name does not tell.")
@click.option("--camera", help="One of several.")
def convert(source: Path, destination: Path, origin: str | None, target: str | None, camera: str | None) -> None:
    """Convert cameras between formats: OpenCV YAML, Kalibr, ROS, COLMAP, mrcal, camera.yaml; a rig.yaml as source.

    \b
    Example:
        beampose calibrate convert sample_runs/huo2015/rig.yaml camchain.yaml --to kalibr
    """
    from lab.files.rig.interchange import convert as convert_file

    _concluded(convert_file(source, destination, origin, target, camera))


@calibrate.command("simulate")
@click.option("--out", required=True, type=_FOLDER, help="The folder to write; it must not exist yet.")
@click.option("--rig", default="fan", show_default=True, help="One of lab/simulate/rigs.py.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="The same seed, the same bytes.")
@click.option("--positions", default=40, show_default=True, type=click.IntRange(min=3), help="Of the stand.")
@click.option("--photos", is_flag=True, help="Board photographs for `calibrate camera` too.")
def simulate_campaign(out: Path, rig: str, seed: int, positions: int, photos: bool) -> None:
    """Write a simulated calibration campaign with its truth, to try all this on.

    \b
    Example:
        beampose calibrate simulate --out campaign
    """
    from lab.simulate.campaign_files import simulate_calibration

    folder = simulate_calibration(out, seed=seed, rig=rig, positions=positions, photos=photos)
    click.echo(f"project: {folder / 'calibration.yaml'}")


def _ranges(
    ctx: click.Context, parameter: click.Parameter, values: Sequence[str]
) -> dict[str, tuple[float, float, int]]:
    """--range name=first:last:count."""
    out: dict[str, tuple[float, float, int]] = {}
    for text in values:
        name, _, value = text.partition("=")
        try:
            first, last, count = value.split(":")
            out[name.strip()] = float(first), float(last), int(count)
        except ValueError:
            raise click.BadParameter(
                f"expected NAME=FIRST:LAST:COUNT, got {text!r}", ctx=ctx, param=parameter
            ) from None
    return out


@main.command()
@click.argument("rig", type=_ANY_PATH)
@click.option("--out", required=True, type=_FOLDER, help="Gets plan.csv, effects.csv and report.html.")
@click.option(
    "--range",
    "ranges",
    multiple=True,
    metavar="NAME=FIRST:LAST:COUNT",
    callback=_ranges,
    help="Of x_m, y_m, z_m, yaw_deg, pitch_deg, roll_deg; e.g. --range yaw_deg=-30:30:13.",
)
@click.option("--sigma-px", type=click.FloatRange(min=0, min_open=True), help="Noise of a spot, 1 sigma.")
@click.option("--goal-deg", type=click.FloatRange(min=0, min_open=True), help="The attitude sigma to reach.")
@click.option("--goal-mm", type=click.FloatRange(min=0, min_open=True), help="The position sigma to reach.")
@click.option(
    "--expect",
    "settings",
    multiple=True,
    metavar="NAME=VALUE",
    callback=_settings,
    help="A calibration sigma to expect, where the rig file states none; e.g. --expect beam_direction_arcsec=10.",
)
def plan(
    rig: Path,
    out: Path,
    ranges: dict[str, tuple[float, float, int]],
    sigma_px: float | None,
    goal_deg: float | None,
    goal_mm: float | None,
    settings: dict[str, Any],
) -> None:
    """Before a rig is built: which spots are seen from where, and how well it will measure.

    \b
    Example:
        beampose plan sample_runs/huo2015/rig.yaml --out results/plan
    """
    from lab.plan.plan import plan_rig
    from lab.plan.plan_options import options_of

    goal_m = None if goal_mm is None else goal_mm / 1000
    options = options_of(ranges, sigma_px=sigma_px, goal_deg=goal_deg, goal_m=goal_m, expected=settings)
    _concluded(plan_rig(rig, out, options))


if __name__ == "__main__":
    main()
