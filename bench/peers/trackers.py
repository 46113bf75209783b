"""The compared trackers by name: ours, and those of other packages with their best parameters.

The parameters of the other trackers were chosen by IDF1 among two or three settings each, on 700 frames of standard,
fast and reversal of seed 3. Slow trackers run with the first seeds only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

from bench.peers.rows import Tracked
from bench.peers.scenes import Scene

OURS = ("rigid", "rigid-smoothed", "spots")


@dataclass(frozen=True, slots=True)
class Entry:
    """One tracker with its settings."""

    name: str
    module: str  # of bench.peers, with track(scene, **options)
    library: str | None = None  # required package; None: ours
    options: Mapping[str, object] = field(default_factory=dict)
    seeds: int | None = None  # largest number of the given seeds; None: all

    @property
    def installed(self) -> bool:
        """Whether the package is installed; ours always are."""
        return self.library is None or find_spec(self.library) is not None

    @property
    def library_version(self) -> str:
        """The name and version of the package, such as `norfair 2.3.0`; for ours those of the program."""
        name = self.library or "beampose"
        try:
            return f"{name} {version(name)}"
        except PackageNotFoundError:  # beampose run from its folder
            return name

    def track(self, scene: Scene) -> Tracked:
        """The rows of one scene. Exceptions of the package are not caught."""
        tracked: Tracked = import_module(f"bench.peers.{self.module}").track(scene, **self.options)
        return tracked


ENTRIES = {
    entry.name: entry
    for entry in (
        Entry("rigid", "ours", options={"method": "rigid"}),
        Entry("rigid-smoothed", "ours", options={"method": "rigid", "smoothed": True}),
        # On dense, `spots` searches for the vehicle again in a third of the frames: 0.13 s each, minutes for a scene.
        Entry("spots", "ours", options={"method": "spots"}, seeds=1),
        Entry("pyrecest-jpda", "adapters.with_pyrecest", "pyrecest", {"association": "jpda", "q": 2.0}, seeds=2),
        Entry("pyrecest-gnn", "adapters.with_pyrecest", "pyrecest", {"association": "gnn", "q": 2.0}, seeds=2),
        Entry("stonesoup-gnn", "adapters.with_stonesoup", "stonesoup", {"q": 3.0}, seeds=1),
        Entry("norfair", "adapters.with_norfair", "norfair", {"R": 4.0, "Q": 0.1}, seeds=2),
        Entry("bytetrack", "adapters.with_bytetrack", "trackers", {"half_px": 40.0}, seeds=2),
        Entry("laptrack", "adapters.with_laptrack", "laptrack", {"gate_px": 45.0, "gap_px": 150.0}, seeds=1),
        Entry("trackpy", "adapters.with_trackpy", "trackpy", {"gate_px": 25.0, "frames_kept": 20}, seeds=1),
    )
}
