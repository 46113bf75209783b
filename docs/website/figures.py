"""Makes the pictures of the documentation: `python -m docs.website.figures` writes them into docs/images.

The program's own commands run on simulated boards, campaigns and recordings; the figures are those of their reports.
`python -m docs.website.figures report` makes only docs/report.png, the report of sample_runs/huo2015 in Chromium.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / "docs" / "images"
TOUR = ROOT / "docs" / "tour"
COMMANDS = (
    "calibrate simulate --photos --seed 3 --out campaign",
    "calibrate board charuco:5x7:36mm:18mm:DICT_4X4_50 --out board",
    "calibrate camera campaign/photos/left --board campaign/board.yaml --distance-m 4.4 --out left",
    "calibrate rig campaign --out rig",
    "plan campaign/truth/rig.yaml --range yaw_deg=-30:30:13 --range pitch_deg=-20:20:9 --out plan",
    "study huo2015 --out study",
    # the run of the tutorial
    "init my-lab --screens 2 --cameras 2 --beams 3 --rate 100",
    "calibrate simulate --rig my-lab/rig.yaml --seed 1 --out my-campaign",
    "calibrate rig my-campaign --out my-rig",
    "simulate small-motion --rig my-campaign/truth/rig.yaml --known-rig my-rig/rig.yaml --frames 200 --light quiet"
    " --seed 1 --out my-run",
    "run my-run --out day-1",
    # the tour
    f"calibrate camera {TOUR}/left --board chessboard:9x6:25mm --out tour-left",
    f"calibrate camera {TOUR}/webcam --board chessboard:9x7:24.4mm --out tour-webcam",
    f"detect {TOUR}/room.jpg --out tour-room",
)
FAILING = {"tour-webcam": 3}  # exit statuses that the pages show
# Name of the picture: the folder of the report, the beginning of the label of its figure there, which of several.
FIGURES = {
    "plan-attitude": ("plan", "Attitude sigma (mdeg), maximum", 0),
    "plan-spots": ("plan", "Spots in view", 0),
    "lens-models": ("left", "Lens models", 0),
    "lens-uncertainty": ("left", "The same on a screen", 0),
    "lens-coverage": ("left", "Where the sensor had corners", 0),
    "lens-tilt": ("left", "How the boards were tilted", 0),
    "rig": ("rig", "Cameras, screens and beams, seen obliquely", 0),
    "rig-held-out": ("rig", "Attitude error of held-out positions", 0),
    "rig-residuals": ("rig", "Camera left: control points", 0),
    "run-yaw": ("day-1", "yaw", 0),
    "run-yaw-error": ("day-1", "yaw: ", 0),
    "run-status": ("day-1", "Status of the pose", 0),
    "tour-coverage": ("tour-left", "Where the sensor had corners", 0),
    "tour-uncertainty": ("tour-left", "Uncertainty of a pixel", 0),
    "tour-webcam-coverage": ("tour-webcam", "Where the sensor had corners", 0),
    "tour-webcam-uncertainty": ("tour-webcam", "Uncertainty of a pixel", 0),
    "huo2015/prediction-conventional": ("study", "conventional, stiff", 0),
    "huo2015/prediction-switching": ("study", "curve switching, stiff", 0),
    "huo2015/out-of-view-3": ("study", "spot 3: distance from truth", 0),
    "huo2015/out-of-view-6": ("study", "spot 6: distance from truth", 0),
    "huo2015/tracks-left": ("study", "tracks of camera left", 0),
    "huo2015/tracks-right": ("study", "tracks of camera right", 0),
    "huo2015/tracking-error-3": ("study", "spot 3 (left): estimate", 0),
}
_FIGURE = re.compile(r'<svg class="plot"[^>]*aria-label="(?P<label>[^"]*)".*?</svg>', re.DOTALL)
_RIGHT = 14.0  # px added on the right: in a report, words may reach beyond the figure
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
REPORT_SIZE = (1200, 1640)  # px of docs/report.png
PHOTOS = (0, 3, 7, 11, 15, 19)  # of the campaign's photographs, in the picture of how to take them


def figures_of(html: str) -> list[tuple[str, str]]:
    """Label and SVG of every figure of a report."""
    return [(match["label"], match[0]) for match in _FIGURE.finditer(html)]


def styles() -> str:
    """The rules of the reports' style sheet that concern figures, with its colours by day."""
    sheet = (ROOT / "lab" / "report" / "templates" / "style.css").read_text(encoding="utf-8")
    colours = dict(re.findall(r"(--[\w-]+):([^;}]+)", re.search(r":root\{([^}]*)\}", sheet)[1]))  # type: ignore[index]
    rules = ""
    for selectors, body in re.findall(
        r"([^{}@]+)\{([^{}]*)\}", re.sub(r"@media[^{]*\{(?:[^{}]*\{[^{}]*\})*\}", "", sheet)
    ):
        of_figures = [part.strip() for part in selectors.split(",") if part.strip().startswith("svg ")]
        rules += f"{','.join(of_figures)}{{{body}}}" if of_figures else ""
    for name, value in colours.items():
        rules = rules.replace(f"var({name})", value)
    return rules


def standalone(svg: str) -> str:
    """A figure of a report as a file of its own, on white."""
    wide, height = map(float, re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg).groups())  # type: ignore[union-attr]
    width = wide + _RIGHT
    head, body = svg.split(">", 1)
    head = re.sub(r'viewBox="[^"]*"', f'viewBox="0 0 {width:g} {height:g}"', head)
    head = re.sub(r' data-[\w-]+="[^"]*"', "", head).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ')
    font = "svg{font-family:system-ui,'Segoe UI',Arial,'Liberation Sans',sans-serif}"
    paper = f'<rect width="{width:g}" height="{height:g}" fill="#fff"/>'
    return f'{head} width="{width:g}" height="{height:g}"><style>{font}{styles()}</style>{paper}{body}\n'


def mosaic(photos: list[Path], columns: int = 3, width: int = 360) -> np.ndarray:
    """Photographs side by side, reduced to `width` px each, with white lines between them."""
    small = []
    for path in photos:
        photo = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if photo is None:
            raise FileNotFoundError(path)
        size = (width, round(photo.shape[0] * width / photo.shape[1]))
        small.append(cv2.copyMakeBorder(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), *[3] * 4, 0, value=255))
    return np.vstack([np.hstack(small[i : i + columns]) for i in range(0, len(small), columns)])


def reduced(path: Path, to: Path, width: int) -> None:
    """Write a picture again, so many pixels wide. Raises FileNotFoundError."""
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise FileNotFoundError(path)
    size = (width, round(picture.shape[0] * width / picture.shape[1]))
    options = [cv2.IMWRITE_JPEG_QUALITY, 80] if to.suffix == ".jpg" else []
    cv2.imwrite(str(to), cv2.resize(picture, size, interpolation=cv2.INTER_AREA), options)


def beampose(command: str, folder: Path) -> None:
    """Run a command of this checkout in a folder. Raises CalledProcessError."""
    print(f"beampose {command}", flush=True)
    start = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from cli import main; main(prog_name='beampose')"
    done = subprocess.run([sys.executable, "-P", "-c", start, *command.split()], cwd=folder, check=False)
    if done.returncode != FAILING.get(command.split()[-1], 0):
        raise subprocess.CalledProcessError(done.returncode, command)


def shown(html: str) -> list[str]:
    """What the picture of a report shows, as text: the verdict, and name and value of each key figure.

    docs/report.txt has these lines of docs/report.png; tests compare them with today's reports.
    """
    verdict = re.search(r'<strong class="word">(\w+)</strong>', html)
    figures = re.findall(r'<span class="name">(.*?)</span><span class="value">(.*?)</span>', html)
    return [verdict[1] if verdict else "", *(f"{name}: {value}" for name, value in figures)]


def make_report_picture(work: Path, picture: Path) -> None:
    """The beginning of the report of sample_runs/huo2015, as headless Chromium shows it, and what it shows as text.

    Raises:
        CalledProcessError: a command failed.
        LookupError: there is no Chromium.
    """
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise LookupError(f"docs/report.png needs one of {', '.join(BROWSERS)}; on Debian: apt-get install chromium")
    beampose(f"run {ROOT / 'sample_runs' / 'huo2015'} --out huo2015", work)
    options = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
        f"--user-data-dir={work / 'browser'}",
    ]
    shot = [f"--window-size={REPORT_SIZE[0]},{REPORT_SIZE[1]}", f"--screenshot={picture}"]
    report = work / "huo2015" / "report.html"
    subprocess.run([browser, *options, *shot, report.as_uri()], check=True)
    picture.with_suffix(".txt").write_text("\n".join(shown(report.read_text("utf-8"))) + "\n", encoding="utf-8")


def make(work: Path, images: Path) -> None:
    """Run the commands in the folder `work` and write all pictures into `images`.

    Raises:
        CalledProcessError: a command failed.
        LookupError: a report has no such figure.
    """
    for command in COMMANDS:
        beampose(command, work)
    for name, (folder, label, which) in FIGURES.items():
        found = [
            svg
            for text, svg in figures_of((work / folder / "report.html").read_text("utf-8"))
            if text.startswith(label)
        ]
        if len(found) <= which:
            raise LookupError(f"{folder}/report.html has no figure {label!r}")
        path = images / f"{name}.svg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(standalone(found[which]), encoding="utf-8")
    shutil.copyfile(work / "study" / "figures.csv", images / "huo2015" / "figures.csv")
    photos = [work / "campaign" / "photos" / "left" / f"{k:02d}.png" for k in PHOTOS]
    cv2.imwrite(str(images / "photos.jpg"), mosaic(photos), [cv2.IMWRITE_JPEG_QUALITY, 80])
    reduced(work / "board" / "board.png", images / "board.png", 420)
    reduced(work / "tour-room" / "contact-sheet.png", images / "tour-room.jpg", 900)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="beampose-figures-") as folder:
        if sys.argv[1:] != ["report"]:
            make(Path(folder), IMAGES)
        make_report_picture(Path(folder), ROOT / "docs" / "report.png")
