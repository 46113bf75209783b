"""The possible mistakes of setting up a rig: each one as the rig, the pictures and the prior without it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations
from types import MappingProxyType

import numpy as np

from geometry.arrays import Array
from geometry.camera import FISHEYE, Camera
from geometry.forward_model import SpotModel
from geometry.pose import Pose
from geometry.pose_prior import PosePrior
from geometry.pose_solver.visibility import assumed_range, poses_within
from geometry.rig import Rig
from geometry.rotations import matrix_from_quaternion, quaternion_from_matrix
from tracking.detections import Detections

FEW_POSES = 40  # of the range, in which a mistake that changes any pixel shows
# The points of consecutive pictures by camera: of the frame before, the frame itself and the frame after. A camera
# without a picture is absent.
Block = Sequence[Mapping[str, Detections]]
HERE = 1  # index of the frame itself


@dataclass(frozen=True, slots=True)
class PictureChange:
    """How the picture that a camera of the rig took follows from a recorded one: uv_px = turn @ recorded + shift."""

    source: str  # the camera under whose name it is recorded
    turn: Array = field(default_factory=lambda: np.eye(2))  # (2, 2)
    shift: Array = field(default_factory=lambda: np.zeros(2))  # (2,) px
    later: int = 0  # frames: the number under which it is recorded minus its own; -1, 0 or 1

    def of(self, found: Detections) -> Detections:
        """The points of the camera's picture, from those of the recorded one."""
        uv = found.uv_px @ self.turn.T + self.shift
        return replace(found, uv_px=uv, cov_px2=self.turn @ found.cov_px2 @ self.turn.T)

    def recorded(self, uv_px: Array) -> Array:
        """Recorded pixels (..., 2) of pixels of the camera's picture."""
        return np.asarray((uv_px - self.shift) @ np.linalg.inv(self.turn).T)


@dataclass(frozen=True, slots=True)
class Mistake:
    """A mistake that may have been made."""

    kind: str  # a key of SHOWN_BY
    what: str
    remedy: str
    rig: Rig  # as it is without the mistake
    pictures: Mapping[str, PictureChange] = field(default_factory=dict)  # by camera; others are as recorded
    prior: PosePrior | None = None  # as it is without the mistake; None: as given
    by_itself: bool = False  # numbers of the files show it, without a recording
    beams: tuple[str, ...] = ()  # whose spots it changes

    def counterparts(self, given: Rig) -> tuple[Mistake, Mistake]:
        """Of wrong numbers of one camera: frames as given and without the mistake, with its pictures exchanged.

        The picture that a frame has without the mistake with the pictures of the others that belong to it as given, and
        the reverse.
        """
        later = next(iter(self.pictures.values())).later
        every = {n: PictureChange(n, later=later) for n in given.cameras}
        others = {n: PictureChange(n, later=-later) for n in given.cameras if n not in self.pictures}
        return replace(self, pictures=every), replace(self, pictures=others)

    @property
    def elsewhere(self) -> Mistake:
        """What frames show that only a rig without the spots of its beams explains: these are not where it says."""
        what = f"no spot of beam {_names(self.beams)} is where the rig puts it: its direction or point is wrong"
        return replace(self, what=what, remedy="calibrate the beams again (`beampose calibrate beams`)")

    def cameras(self, given: Rig) -> set[int]:
        """Indices of the cameras whose pictures, lens, place or screen the mistake changes."""
        screens = {n for n, s in given.screens.items() if self.rig.screens[n] is not s}
        return {
            i
            for i, (n, c) in enumerate(given.cameras.items())
            if n in self.pictures or self.rig.cameras[n] is not c or c.screen in screens
        }

    def points(self, block: Block) -> dict[str, Detections]:
        """The points of the frame in the middle of a block, by camera, as they are without the mistake."""
        out = {}
        for name in self.rig.cameras:
            change = self.pictures.get(name)
            if change is None:
                found = block[HERE].get(name)
            else:
                found = block[HERE + change.later].get(change.source)
                found = None if found is None else change.of(found)
            if found is not None:
                out[name] = found
        return out


def effect_on(given: Rig, outside: bool = False) -> Callable[[Mistake], bool]:
    """Whether a mistake changes more than names: the pictures, the prior, or the points of some pose.

    outside: also points outside the pictures, of a rig that few poses let see its spots.
    """
    poses = poses_within(assumed_range(given), FEW_POSES)
    unchanged = _points_of(given, poses, outside)

    def has_effect(m: Mistake) -> bool:
        stated = m.pictures or m.prior is not None or m.by_itself
        return bool(stated) or not all(map(np.array_equal, _points_of(m.rig, poses, outside), unchanged))

    return has_effect


def _points_of(rig: Rig, poses: Pose, outside: bool) -> list[Array]:
    """The pixels at poses (k,) by camera and pose, sorted and rounded: which spots they are plays no part."""
    model = SpotModel.of(rig)
    pixels = np.round(model.project(poses)[0], 6)
    there = np.asarray(np.isfinite(pixels).all(axis=-1)) if outside else model.in_picture(pixels)
    pixels = np.where(there[..., None], pixels, np.inf)
    keys = np.stack([np.broadcast_to(model.camera_of, pixels.shape[:2]), pixels[..., 0], pixels[..., 1]], axis=-1)
    return [frame[np.lexsort(frame.T)] for frame in keys]


# What shows a mistake of each kind that a recording cannot show, because the set-up is symmetric.
SHOWN_BY = MappingProxyType(
    {
        "exchanged": "cover the lens of one camera for some frames: the pictures of that camera must be empty",
        "turned": "film a page of text on the screen: it must be readable and upright as in the room",
        "size": "compare the size of the pictures with `image_size_px`, and both with those of the calibration",
        "pose": "measure the distance from that camera to two points of its screen with a tape",
        "unit": "measure the distance between two cameras with a tape",
        "focal": "compute the focal length in pixels: millimetres of the lens / millimetres of a pixel",
        "numbers": "film one flash with all cameras: it must be in the pictures of the same number",
        "target": "cover one beam at the vehicle: the spots of that beam must disappear",
        "lens": "photograph a board with that camera (`beampose calibrate camera`)",
        "prior": "measure the first pose with a tape",
    }
)


FAR_M = 100.0  # a camera or screen farther from the others, or a larger screen, is not in a lab ...
FAR_ON_TARGET_M = 10.0  # ... and a point of a beam farther from the body's origin is not on a vehicle model
SHORT_FOCAL = 1 / 12  # focal length over picture width of a perspective lens with a field of view of 161 deg
PIXEL_MM = 0.005  # an assumed pixel, to try a focal length that is given in millimetres

# Turns of a picture in steps of a right angle, and mirrored ones: the matrix from recorded to true pixels, the words
# for the recorded picture, and what to do.
_TURNS = (
    ([[-1, 0], [0, 1]], "mirrored left to right", "mirror them back, or switch mirroring off in the camera"),
    ([[1, 0], [0, -1]], "mirrored upside down", "mirror them back, or switch mirroring off in the camera"),
    ([[-1, 0], [0, -1]], "turned by 180 deg", "turn them back, or switch rotation off in the camera"),
    ([[0, 1], [-1, 0]], "turned by 90 deg clockwise", "turn them back, or switch rotation off in the camera"),
    ([[0, -1], [1, 0]], "turned by 90 deg anticlockwise", "turn them back, or switch rotation off in the camera"),
    ([[0, 1], [1, 0]], "transposed (rows and columns exchanged)", "write them with rows and columns exchanged"),
    ([[0, -1], [-1, 0]], "transposed and turned by 180 deg", "write them with rows and columns exchanged and turned"),
)


def possible_mistakes(rig: Rig, prior: PosePrior | None = None) -> list[Mistake]:
    """All mistakes that are tested for a rig as it is given, and the prior of its run."""
    return [*_pictures(rig), *_camera_poses(rig), *_units(rig), *_lenses(rig), *_target(rig), *_prior(rig, prior)]


def _pictures(rig: Rig) -> Iterator[Mistake]:
    """Pictures that are not those of the camera, of this size, orientation or number."""
    for a, b in combinations(rig.cameras, 2):
        alike = _equal_lenses(rig.cameras[a], rig.cameras[b])
        yield Mistake(
            "exchanged",
            f"the pictures of cameras `{a}` and `{b}` are exchanged" + alike * ", or they have each other's place",
            f"exchange the names of `{a}` and `{b}` in run.yaml or in the table of points"
            + alike * ", or their camera_from_world and screen in rig.yaml",
            rig,
            {a: PictureChange(b), b: PictureChange(a)},
        )
    for of, names in _each_and_all(rig.cameras):
        for rows, words, remedy in _TURNS:
            yield Mistake(
                "turned",
                f"the pictures of {of} are {words}",
                f"{remedy}; camera.yaml and the run need the same orientation",
                rig,
                {n: _turned(rig.cameras[n], np.array(rows, dtype=float)) for n in names},
            )
    for name, camera in rig.cameras.items():
        width, height = camera.image_size_px
        quarter = np.array([width, height]) // 4
        yield Mistake(
            "size",
            f"the pictures of camera `{name}` are the middle half of those that it was calibrated with (cropped)",
            "read out the whole sensor, or subtract the crop's corner from cx, cy",
            rig,
            {name: PictureChange(name, shift=quarter.astype(float))},
        )
        for later in (-1, 1):
            yield Mistake(
                "numbers",
                f"the pictures of camera `{name}` have numbers one too {'high' if later > 0 else 'low'} (numbered from"
                f" {'1' if later > 0 else '0'} where the others start at {'0' if later > 0 else '1'}?)",
                f"renumber the pictures of `{name}`, so that the same number is the same instant in all cameras",
                rig,
                {name: PictureChange(name, later=later)},
            )
    for words, names in _each_and_all(rig.cameras):
        for scale, what in ((2.0, "half"), (0.5, "twice")):
            shift = np.full(2, 0.5 * scale - 0.5)
            yield Mistake(
                "size",
                f"the pictures of {words} have {what} the resolution of those that it was calibrated with",
                "record with the calibrated resolution, or scale fx, fy, cx, cy and image_size_px",
                rig,
                {n: PictureChange(n, scale * np.eye(2), shift) for n in names},
            )


def _turned(camera: Camera, turn: Array) -> PictureChange:
    # A coordinate that runs backwards ends at the last pixel of the picture that the rig describes.
    return PictureChange(camera.name, turn, np.where(turn.sum(axis=1) < 0, np.array(camera.image_size_px) - 1.0, 0.0))


def _camera_poses(rig: Rig) -> Iterator[Mistake]:
    """Transforms in the wrong direction, and quaternions in another order."""
    kinds = (
        ("camera_from_world", "world_from_camera", {n: c.camera_from_world for n, c in rig.cameras.items()}),
        ("world_from_screen", "screen_from_world", {n: s.world_from_screen for n, s in rig.screens.items()}),
    )
    for (name, inverse, poses), word, changed in zip(
        kinds, ("camera", "screen"), (_with_camera_poses, _with_screen_poses), strict=True
    ):
        for words, names in _each_and_all(poses, word):
            yield Mistake(
                "pose",
                f"{name} of {words} is {inverse}: the inverse",
                "invert the rotation and the translation in rig.yaml",
                changed(rig, {n: poses[n].inverse() for n in names}),
            )
            yield Mistake(
                "pose",
                f"the quaternion of {name} of {words} is in the order x, y, z, w",
                "write quaternion_wxyz in rig.yaml with w first",
                changed(rig, {n: _reordered(poses[n]) for n in names}),
            )
    every = _with_camera_poses(rig, {n: _reordered(c.camera_from_world) for n, c in rig.cameras.items()})
    every = _with_screen_poses(every, {n: _reordered(s.world_from_screen) for n, s in rig.screens.items()})
    yield Mistake(
        "pose",
        "all quaternions of the rig are in the order x, y, z, w",
        "write quaternion_wxyz in rig.yaml with w first",
        every,
    )


def _units(rig: Rig) -> Iterator[Mistake]:
    """Lengths in millimetres, where they are too large for a lab."""
    far_cameras, far_screens = _far(rig)
    # The fewest of them whose conversion brings all places together.
    none: list[str] = []
    for cameras, screens in ((none, none), (far_cameras, none), (none, far_screens), (far_cameras, far_screens)):
        changed = _with_camera_poses(rig, {n: _in_metres(rig.cameras[n].camera_from_world) for n in cameras})
        changed = _with_screen_poses(changed, {n: _in_metres(rig.screens[n].world_from_screen) for n in screens})
        if not any(_far(changed)):
            break
    beams = [n for n, b in rig.beams.items() if np.linalg.norm(b.point) > FAR_ON_TARGET_M]
    in_metres = {n: replace(rig.beams[n], point=rig.beams[n].point / 1000) for n in beams}
    sizes = {n: s.size_m for n, s in rig.screens.items() if s.size_m is not None and max(s.size_m) > FAR_M}
    smaller = {n: replace(changed.screens[n], size_m=(w / 1000, h / 1000)) for n, (w, h) in sizes.items()}
    changed = replace(changed, screens={**changed.screens, **smaller})
    fields = ("camera_from_world", "world_from_screen", "size_m", "point_m")
    words = [f"{f} of {_names(n)}" for f, n in zip(fields, (cameras, screens, list(sizes), beams), strict=True) if n]
    if words:
        yield Mistake(
            "unit",
            f"the lengths of {' and '.join(words)} are in millimetres",
            "write them in metres in rig.yaml",
            replace(changed, beams={**rig.beams, **in_metres}),
            by_itself=True,
        )


def _far(rig: Rig) -> tuple[list[str], list[str]]:
    """Names of the cameras and of the screens that are too far from the middle of all for a lab."""
    middle = _middle(rig)
    cameras = [n for n, c in rig.cameras.items() if _is_far(c.camera_from_world.inverse(), middle)]
    return cameras, [n for n, s in rig.screens.items() if _is_far(s.world_from_screen, middle)]


def _lenses(rig: Rig) -> Iterator[Mistake]:
    """Focal lengths in millimetres, and lenses or places of another camera."""
    short = [
        n for n, c in rig.cameras.items() if c.lens != FISHEYE and c.matrix[0, 0] < SHORT_FOCAL * c.image_size_px[0]
    ]
    if short:
        scale = np.array([[1 / PIXEL_MM, 1, 1], [1, 1 / PIXEL_MM, 1], [1, 1, 1]])
        yield Mistake(
            "focal",
            f"fx, fy of {_names(short)} ({rig.cameras[short[0]].matrix[0, 0]:.4g}) are in millimetres",
            "write them in pixels in rig.yaml: millimetres of the lens / millimetres of a pixel",
            _with_cameras(rig, {n: replace(rig.cameras[n], matrix=rig.cameras[n].matrix * scale) for n in short}),
            by_itself=True,
        )
    for a, b in combinations(rig.cameras, 2):
        one, other = rig.cameras[a], rig.cameras[b]
        if not _equal_lenses(one, other):
            pairs = ((a, one, other), (b, other, one))  # of equal cameras it would be that of exchanged pictures
            yield Mistake(
                "pose",
                f"cameras `{a}` and `{b}` have each other's place",
                f"exchange camera_from_world and screen of `{a}` and `{b}` in rig.yaml",
                _with_cameras(
                    rig,
                    {n: replace(c, camera_from_world=d.camera_from_world, screen=d.screen) for n, c, d in pairs},
                ),
            )
        yield Mistake(
            "lens",
            f"cameras `{a}` and `{b}` have each other's lens (camera.yaml exchanged)",
            "exchange camera_matrix and distortion of the two cameras in rig.yaml",
            _with_cameras(rig, {a: _with_lens_of(one, other), b: _with_lens_of(other, one)}),
        )
    for a, b in permutations(rig.cameras, 2):
        yield Mistake(
            "lens",
            f"camera `{a}` has a wrong lens: that of camera `{b}` fits",
            f"enter camera_matrix and distortion of the right camera.yaml for `{a}`",
            _with_cameras(rig, {a: _with_lens_of(rig.cameras[a], rig.cameras[b])}),
        )


def _target(rig: Rig) -> Iterator[Mistake]:
    """Beams that are exchanged, or their ends. (Two spots of one screen that are exchanged only exchange names.)"""
    for a, b in combinations(rig.beams, 2):
        one, other = rig.beams[a], rig.beams[b]
        yield Mistake(
            "target",
            f"beams `{a}` and `{b}` are exchanged",
            "exchange their direction and point_m in rig.yaml",
            replace(rig, beams={**rig.beams, a: replace(other, name=a), b: replace(one, name=b)}),
            beams=(a, b),
        )
    for a in rig.beams:
        beam = rig.beams[a]
        yield Mistake(
            "target",
            f"the ends of beam `{a}` are exchanged",
            "exchange + and - of its spots, or reverse its direction, in rig.yaml",
            replace(rig, beams={**rig.beams, a: replace(beam, direction=-beam.direction)}),
            beams=(a,),
        )


def _prior(rig: Rig, prior: PosePrior | None) -> Iterator[Mistake]:
    """A prior in other units, or one that does not contain the first pose."""
    if prior is None:
        return
    ypr = prior.centre.ypr
    degrees = Pose.from_ypr(np.rad2deg(ypr), prior.centre.translation)
    turned, wide = (float(np.rad2deg(angle)) for angle in (np.abs(ypr).max(), prior.within_rad))
    # The numbers as written must be angles in radians, or every attitude would be tried for any wrong prior.
    are_angles, is_range = turned <= 2 * np.pi, wide <= np.pi
    for possible, centre, within, words in (
        (are_angles and is_range, degrees, wide, "yaw_pitch_roll_deg and within_deg are"),
        (are_angles, degrees, prior.within_rad, "yaw_pitch_roll_deg is"),
        (is_range, prior.centre, wide, "within_deg is"),
    ):
        if possible:
            yield Mistake(
                "unit",
                f"prior: {words} in radians",
                "write it in degrees in run.yaml",
                rig,
                prior=replace(prior, centre=centre, within_rad=within),
            )
    if prior.within_m > FAR_M or _is_far(prior.centre, _middle(rig)):
        yield Mistake(
            "unit",
            "prior: position_m or within_m is in millimetres",
            "write it in metres in run.yaml",
            rig,
            prior=replace(
                prior,
                centre=Pose(prior.centre.rotation, prior.centre.translation / 1000),
                within_m=prior.within_m / 1000 if prior.within_m > FAR_M else prior.within_m,
            ),
            by_itself=True,
        )
    yield Mistake(
        "prior",
        "prior: the first pose is outside it",
        "correct position_m and yaw_pitch_roll_deg in run.yaml, or make within_m and within_deg larger",
        rig,
        prior=PosePrior.everywhere(rig),
    )


def _middle(rig: Rig) -> Array:
    """The median (3,), m, of the places of cameras and screens; a world may have its origin far away."""
    cameras = [c.camera_from_world.inverse().translation for c in rig.cameras.values()]
    return np.asarray(np.median([*cameras, *(s.world_from_screen.translation for s in rig.screens.values())], axis=0))


def _is_far(pose: Pose, middle: Array) -> bool:
    return bool(np.linalg.norm(pose.translation - middle) > FAR_M)


def _each_and_all(names: Mapping[str, object], word: str = "camera") -> Iterator[tuple[str, list[str]]]:
    """Words for each name, and for all of them."""
    for name in names:
        yield f"{word} `{name}`", [name]
    if len(names) > 1:
        yield f"all {word}s", list(names)


def _names(names: Sequence[str]) -> str:
    return ", ".join(f"`{n}`" for n in names)


def _with_cameras(rig: Rig, cameras: Mapping[str, Camera]) -> Rig:
    return replace(rig, cameras={**rig.cameras, **cameras})


def _with_camera_poses(rig: Rig, poses: Mapping[str, Pose]) -> Rig:
    return _with_cameras(rig, {n: replace(rig.cameras[n], camera_from_world=pose) for n, pose in poses.items()})


def _with_screen_poses(rig: Rig, poses: Mapping[str, Pose]) -> Rig:
    screens = {n: replace(rig.screens[n], world_from_screen=pose) for n, pose in poses.items()}
    return replace(rig, screens={**rig.screens, **screens})


def _equal_lenses(one: Camera, other: Camera) -> bool:
    return np.array_equal(one.matrix, other.matrix) and one.distortion == other.distortion


def _with_lens_of(camera: Camera, other: Camera) -> Camera:
    return replace(camera, matrix=other.matrix, distortion=other.distortion, lens=other.lens)


def _in_metres(pose: Pose) -> Pose:
    return Pose(pose.rotation, pose.translation / 1000)


def _reordered(pose: Pose) -> Pose:
    """The transform whose quaternion, in the order x, y, z, w, is that of `pose` in the order w, x, y, z."""
    x, y, z, w = quaternion_from_matrix(pose.rotation)
    return Pose(matrix_from_quaternion(np.array([w, x, y, z])), pose.translation)
