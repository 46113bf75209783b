"""`python -m bench.random_scenes --seeds 1:301`: process random scenes and count the clean ones.

One scene in detail: `--seeds N -v`; `--keep DIR` writes its run folder. `--family NAME`: see families.py; `--variant
NAME`: see variants.py.

`--pictures`: scenes as pictures, including detection (bench/random_pictures; its families are in looks.py).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.random_pictures.command import picture_jobs, run_pictures
from bench.random_pictures.looks import FAMILIES as PICTURE_FAMILIES
from bench.random_scenes.command import Job, judged
from bench.random_scenes.families import FAMILIES
from bench.random_scenes.processes import shown_results
from bench.random_scenes.report import details, summary, write_rows
from bench.random_scenes.variants import CHANGES


def seed_range(text: str) -> range:
    """A:B without B, or one seed."""
    first, _, last = text.partition(":")
    return range(int(first), int(last) if last else int(first) + 1)


def main() -> None:
    """Run the seeds and print the summary."""
    parser = argparse.ArgumentParser(prog="bench.random_scenes", description=__doc__)
    parser.add_argument("--seeds", type=seed_range, metavar="A:B", help="default 1:301, of pictures 1:61")
    parser.add_argument("--family", metavar="NAME", help="one difficulty instead of all at random")
    parser.add_argument("--variant", choices=list(CHANGES), help="a property that random scenes do not have")
    parser.add_argument("--pictures", action="store_true", help="render pictures; --family all: one of each per seed")
    parser.add_argument("--state-noise", action="store_true", help="of pictures: rig.yaml states the true noise")
    parser.add_argument("--frames", type=int, help="default 200, in pictures 48; each family has its own")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--out", type=Path, help="a CSV file with a row per scene")
    parser.add_argument("--through-files", action="store_true", help="write run folders and process those")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="write each scene's run folder there")
    parser.add_argument("-v", "--verbose", action="store_true", help="all figures of every scene")
    a = parser.parse_args()
    known = ["all", *PICTURE_FAMILIES] if a.pictures else list(FAMILIES)
    if a.family is not None and a.family not in known:
        parser.error(f"--family: expected one of {', '.join(known)}; found {a.family}")
    if a.seeds is None:
        a.seeds = range(1, 61 if a.pictures else 301)
    if a.pictures:
        picture = picture_jobs(a.seeds, a.family, a.frames, a.keep, a.state_noise)
        run_pictures(picture, a.jobs, a.out, a.verbose)
        return
    jobs = [Job(s, a.frames, a.family, a.through_files, a.keep, a.variant) for s in a.seeds]
    rows = shown_results(judged, jobs, a.jobs, details if a.verbose else None)
    if a.out is not None:
        write_rows(rows, a.out)
    if a.family is not None:
        print(f"family {a.family}; goal: {FAMILIES[a.family].goal}")
    print(summary(rows))


if __name__ == "__main__":
    main()
