"""Noise model of each camera for the detection: stated in rig.yaml, or estimated from the pictures."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from geometry.arrays import evenly_spread
from geometry.camera import Camera, SensorNoise
from lab.files.run.run_file import Run
from lab.pictures import source as picture_source
from lab.pictures.picture_file import GreyPicture, MissingPicture
from lab.pictures.source import PictureFiles, PictureSource, pictures_of_frames
from lab.runs.frames.frames import FrameReader
from tracking.background.camera_motion import FARTHEST_PX, CameraMotion, shift_between
from tracking.background.estimation import PICTURES, static_background
from tracking.background.static_background import StaticBackground
from tracking.background.wide_lights import WideLights
from tracking.detection.detect import (
    WIDE_PX,
    find_spots,
    find_wide_lights,
    of_all_sizes,
    overlooked_lights,
    saturation_of,
    without_wide,
)
from tracking.detections import Detections
from tracking.noise import NoiseModel, Picture, guess_noise
from tracking.noise_estimation.averaging import RowCounts, kept_of_the_last
from tracking.noise_estimation.grey_values import mosaic_contrast
from tracking.noise_estimation.photon_transfer import NoiseEstimate, estimate_noise
from tracking.noise_estimation.speckle import SIDE
from tracking.noise_estimation.texture import is_limited_by_texture
from tracking.parameters import DetectParameters
from tracking.squares import for_squares, of_squares, squares_of

VIDEO_PICTURES = (0, 1, 8, 9, 16, 17)  # used for the estimate: the end of a video cannot be read without all of it
_SMALL_PX = 0.1  # sigma of the mean attitude of a camera: below it, that is no more than the error of a usual spot
MOTION_PICTURES = 100  # whose mean attitude a camera that moves is taken to have been calibrated in
VIDEO_FRAMES = 60  # at the start of a video from which its static background is made
_BLANK = 3  # consecutive pictures without any point after which the noise model is checked
_BLANK_AGAIN = 50  # it is checked again after this many more
_CONTRADICTION = 2.0  # ratio of the stated to the estimated background variance from which a note is made


def _called(function: Callable[..., Any], *given: Any) -> Any:
    return function(*given)


@dataclass(slots=True)
class CameraNoise:
    """The noise model of one camera, and its source."""

    camera: str
    stated: SensorNoise | None = None
    notes: list[str] = field(default_factory=list)
    optics: Camera | None = None  # calibrated: its rotations from picture to picture are measured
    estimate: NoiseEstimate | None = field(default=None, init=False)
    mosaic: float = field(default=0.0, init=False)  # contrast of a colour mosaic in the pictures; 0: there is none
    model: NoiseModel | None = field(
        default=None, init=False
    )  # in use; None before the first estimate if none is stated
    motion: CameraMotion | None = field(default=None, init=False)  # None: the camera does not move, or none is seen
    background: StaticBackground | None = field(default=None, init=False)  # for faint spots; None: not used
    moved_px: float = field(default=0.0, init=False)  # once or slowly; 0: not, or hardly
    kept: float = field(default=float("nan"), init=False)  # share of a picture from the one before; nan: not known
    interlaced: bool = field(default=False, init=False)  # even and odd rows show two instants
    wide: WideLights | None = field(default=None, init=False)  # None: sums of pixels have no background
    too_wide_px: float = field(default=0.0, init=False)  # sigma of a light that max_sigma_px excludes; 0: none
    px: float = 1.0  # side of its pixels, which may be sums, in pixels of the camera
    shown: float = float("nan")  # misfit_share of the lights in the pixels of these sums; nan: none, or not known
    of_sums: CameraNoise | None = field(default=None, init=False)  # where speckle breaks spots into grains
    unfit: int = field(default=0, init=False)  # consecutive pictures that do not fit the background
    # Of which the noise was estimated, until a background is made: it may show that sums are better
    _first: list[Picture] = field(default_factory=list, init=False)
    _overruled: bool = field(default=False, init=False)  # the stated noise misses visible spots
    _blank: int = field(default=0, init=False)  # consecutive pictures without any point
    _recent: deque[Picture] = field(default_factory=lambda: deque(maxlen=2), init=False)

    def __post_init__(self) -> None:
        self._update_model()

    def estimate_from(self, pictures: Sequence[Picture]) -> None:
        """Estimate the noise from some pictures in temporal order; without any, nothing changes."""
        if not pictures:
            return
        self.estimate = estimate_noise(pictures, self._black_dn)
        shift = self.estimate.texture_shift
        if not np.isfinite(shift.misfit_share):  # in sums spots may be too narrow to show what their pixels did
            self.estimate = replace(self.estimate, texture_shift=replace(shift, misfit_share=self.shown))
        self.mosaic = mosaic_contrast(pictures[0])
        self._update_model()
        self._first = list(pictures) if self.shows_structure and not self.estimate.grainy else []
        self.of_sums = self._of_sums(pictures) if self.estimate.grainy else None
        if self.stated is not None:
            level = self.estimate.model.black_dn
            stated = float(NoiseModel.of(self.stated).variance(level))
            seen = float(self.estimate.model.variance(level))
            if not 1 / _CONTRADICTION < seen / stated < _CONTRADICTION:
                self.notes.append(
                    f"{self.camera}: rig.yaml states noise of {np.sqrt(stated):.3g} DN at the background's level"
                    f" ({level:.4g} DN), the pictures show {np.sqrt(seen):.3g} DN; correct `noise` in rig.yaml, or"
                    " leave it out"
                )

    def _of_sums(self, pictures: Sequence[Picture]) -> CameraNoise:
        """That of sums of SIDE x SIDE pixels of some pictures in temporal order."""
        optics = self.optics
        if optics is not None:
            width, height = optics.image_size_px
            matrix = np.diag([1 / SIDE, 1 / SIDE, 1.0]) @ optics.matrix
            matrix[:2, 2] -= 0.5 * (1 - 1 / SIDE)
            optics = replace(optics, image_size_px=(width // SIDE, height // SIDE), matrix=matrix)
        shown = float("nan") if self.estimate is None else self.estimate.texture_shift.misfit_share
        out = CameraNoise(self.camera, notes=self.notes, optics=optics, px=SIDE * self.px, shown=shown)
        out.estimate_from([squares_of(p, SIDE) for p in pictures])
        return out

    def _in_sums(self, parameters: DetectParameters, picture: Picture) -> DetectParameters:
        return for_squares(self._with_saturation(parameters, picture), picture, SIDE)

    @property
    def grain(self) -> float:
        """`misfit_share` of the lights; in front of a background that of those that move. nan: not known."""
        if self.background is not None:
            return self.background.misfit_share
        return float("nan") if self.estimate is None else self.estimate.texture_shift.misfit_share

    @property
    def shows_structure(self) -> bool:
        """Whether the pictures show texture or objects that hide spots, from which a background may free them."""
        return self.model is not None and is_limited_by_texture(self.model)

    def sees_motion(self, pictures: Sequence[Picture], parameters: DetectParameters) -> bool:
        """Whether pictures spread over the recording show that the camera moves."""
        if not pictures or self.optics is None or self.model is None:
            return False
        clips = self.saturation_dn(pictures[0], parameters)
        return CameraMotion.at_first(pictures, self.optics, self.model, clips) is not None

    def make_background(
        self, pictures: Sequence[Picture], parameters: DetectParameters, call: Callable[..., Any] = _called
    ) -> None:
        """Make the static background of pictures spread over the recording, if that shows more or spares fits.

        call: calls a function with arguments, maybe in another process.
        """
        if pictures and self.of_sums is not None:
            sums = [squares_of(p, SIDE) for p in pictures]
            self.of_sums.make_background(sums, self._in_sums(parameters, pictures[0]), call)
            self._take_over(self.of_sums)
        elif pictures and self.model is not None and self.estimate is not None:
            usual = self._with_saturation(parameters, pictures[0])
            moved_px = float(np.linalg.norm(shift_between(pictures[0], pictures[-1])))
            self.moved_px = self.px * moved_px if moved_px > FARTHEST_PX else 0.0
            motion, still = None, pictures
            if self.optics is not None:
                motion = call(CameraMotion.of, pictures, self.optics, self.model, without_wide(usual))
            if motion is not None:
                clips = saturation_of(usual, pictures[0])
                still = [s for p in pictures if (s := motion.stilled(p, clips)[0]) is not None]
            wide = WideLights.of(still, self.model, usual, partial(call, static_background))
            self.too_wide_px = 0.0 if wide is None else self.px * wide.excluded_px
            shift, others_move = self.estimate.texture_shift, self.too_wide_px > 0
            background = call(static_background, still, self.model, shift, without_wide(usual), others_move)
            self.motion, self.wide, self.background = motion, wide, background
            if background is not None and background.grainy and self._first:
                self.of_sums = self._of_sums(self._first)
                self.make_background(pictures, parameters, call)
            self._first = []

    def _take_over(self, of_sums: CameraNoise) -> None:
        """What the sums of pixels show of the camera."""
        self.motion, self.background = of_sums.motion, of_sums.background
        self.moved_px, self.too_wide_px = of_sums.moved_px, of_sums.too_wide_px

    def forget_background(self) -> None:
        """Search in pictures themselves until another background is made."""
        self.background, self.unfit = None, 0
        if self.of_sums is not None:
            self.of_sums.forget_background()

    def follow_motion(self, pictures: Mapping[int, Picture], parameters: DetectParameters) -> None:
        """Find the mean attitude of a camera that moves in these pictures, by number, and note that it does."""
        if self.of_sums is not None and pictures:
            usual = self._in_sums(parameters, next(iter(pictures.values())))
            self.of_sums.follow_motion({k: squares_of(p, SIDE) for k, p in pictures.items()}, usual)
            self._take_over(self.of_sums)
        elif self.motion is not None and pictures:
            clips = self.saturation_dn(next(iter(pictures.values())), parameters)
            self.motion = self.motion.with_mean_of(pictures, clips)
            how, remedy = "from picture to picture", ". Check its mount and the floor"
            if self.motion.is_slow:
                how, remedy = "once or slowly", ". Find out when it was moved, and calibrate it again"
                if self.motion.mean_variance_px2 > _SMALL_PX**2:  # a finding says when, and what to do
                    self.moved_px, remedy = self.px * self.motion.farthest_px, ""
            self.notes.append(
                f"{self.camera}: the camera moves by {self.px * self.motion.rms_px:.2g} px (rms) {how}; its spots are"
                f" corrected by what stands still in its pictures{remedy}"
            )

    def look_for_wide(self, pictures: Sequence[Picture], parameters: DetectParameters) -> None:
        """Find out whether most of these pictures, without a background, show a light that max_sigma_px excludes."""
        narrow = without_wide(parameters)
        found = [overlooked_lights(p, parameters, self.model, self._search(p, narrow, self.model)) for p in pictures]
        widest = [float(lights.major_px.max(initial=0.0)) for lights in found]
        self.too_wide_px = self.px * float(np.median(widest)) if widest else 0.0

    def detect(self, picture: Picture, parameters: DetectParameters) -> Detections:
        """The points of one picture. After pictures without any point the noise is estimated again."""
        if self.model is None:
            self.estimate_from([picture])
        if self.of_sums is not None:
            usual = self._in_sums(parameters, picture)
            found = of_squares(self.of_sums.detect(squares_of(picture, SIDE), usual), picture, SIDE)
            self.unfit = self.of_sums.unfit
            return found
        if self.motion is None:
            return self._points_in(picture, parameters)
        still, turn = self.motion.stilled(picture, self.saturation_dn(picture, parameters))
        return self.motion.corrected(self._points_in(picture if still is None else still, parameters), turn)

    def _points_in(self, picture: Picture, parameters: DetectParameters) -> Detections:
        """Those of a picture in which the camera stands still."""
        if parameters.max_sigma_px <= WIDE_PX:
            return self._spots_in(picture, parameters)
        usual = self._with_saturation(parameters, picture)
        wide = None if self.wide is None else self.wide.in_picture(picture, usual)
        if wide is None:
            wide = self._with_texture(find_wide_lights(picture, usual, self.model))
        return of_all_sizes(self._spots_in(picture, without_wide(parameters)), wide, usual)

    def _spots_in(self, picture: Picture, parameters: DetectParameters) -> Detections:
        if self.background is not None and self.estimate is not None:
            usual = self._with_saturation(parameters, picture)
            seen = self.background.found_in(picture, usual, self.estimate.texture_shift)
            self.unfit = 0 if seen is not None else self.unfit + 1
            if seen is not None:
                return seen
        found = self._search(picture, parameters, self.model)
        if len(found):
            self._blank = 0
            self._recent.clear()
            return self._with_texture(found)
        self._recent.append(picture)
        self._blank += 1
        if self._blank % _BLANK_AGAIN == _BLANK and len(self._search(picture, parameters, guess_noise(picture))):
            return self._with_texture(self._estimate_again(picture, parameters))
        return found

    def as_mapping(self) -> dict[str, Any]:
        """For summary.json."""
        out: dict[str, Any] = {}
        if self.model is not None:
            out = _scalars(self.model)
            out["source"] = "pictures" if self.stated is None or self._overruled else "rig"
            out["background_pictures"] = 0 if self.background is None else self.background.pictures
            out["camera_motion_px"] = 0.0 if self.motion is None else self.innermost.px * self.motion.rms_px
            out["summed_px"] = int(self.innermost.px)
        if self.estimate is not None:
            seen = asdict(replace(self.estimate, model=replace(self.estimate.model, local_texture=None)))
            del seen["model"]
            out["estimated"] = {**_scalars(self.estimate.model), **seen}
        return out

    def saturation_dn(self, picture: Picture, parameters: DetectParameters) -> float:
        """The grey value at which the sensor clips: stated, seen in the pictures, or the largest of their type."""
        seen = None if self.estimate is None else self.estimate.saturation_dn
        if parameters.saturation_dn is not None or seen is None:
            return saturation_of(parameters, picture)
        return float(seen)

    @property
    def _black_dn(self) -> float | None:
        """The stated grey value without light; 0 is that of a file that does not state it."""
        return None if self.stated is None or self.stated.black_dn <= 0 else self.stated.black_dn

    @property
    def innermost(self) -> CameraNoise:
        """That of the pictures, or sums of pixels, in which the spots are measured."""
        return self if self.of_sums is None else self.of_sums.innermost

    def _search(self, picture: Picture, parameters: DetectParameters, model: NoiseModel | None) -> Detections:
        return find_spots(picture, self._with_saturation(parameters, picture), model)

    def _with_saturation(self, parameters: DetectParameters, picture: Picture) -> DetectParameters:
        return replace(parameters, saturation_dn=self.saturation_dn(picture, parameters))

    def _with_texture(self, found: Detections) -> Detections:
        """The points with covariances that include the errors due to the screen's texture."""
        if self.estimate is None or not len(found):
            return found
        return self.estimate.texture_shift.added_to(found, self.estimate.model)

    def _update_model(self) -> None:
        """Stated values take precedence; the rest is estimated: data sheets lack them."""
        estimated = None if self.estimate is None else self.estimate.model
        if self.stated is None or self._overruled:
            self.model = estimated
            return
        stated = NoiseModel.of(self.stated)
        if estimated is not None:
            stated = replace(
                stated, texture=estimated.texture, banding_dn=estimated.banding_dn, correlation=estimated.correlation,
                compression_dn2=estimated.compression_dn2, local_texture=estimated.local_texture,
                profile=estimated.profile,
            )  # fmt: skip
        self.model = stated

    def _estimate_again(self, picture: Picture, parameters: DetectParameters) -> Detections:
        estimate = estimate_noise(list(self._recent), self._black_dn)
        found = self._search(picture, parameters, estimate.model)
        if len(found):
            self.estimate = estimate
            self._blank = 0
            if self.stated is not None and not self._overruled:
                self._overruled = True
                self.notes.append(
                    f"{self.camera}: with the noise that rig.yaml states no point was found in {_BLANK} pictures that"
                    " show light; the noise of the pictures was used from there on. Correct `noise` in rig.yaml, or"
                    " leave it out"
                )
            self._update_model()
        return found


def _scalars(model: NoiseModel) -> dict[str, Any]:
    """A noise model without its map of the texture."""
    out = asdict(replace(model, local_texture=None))
    del out["local_texture"]
    return out


def camera_noises(run: Run, reader: FrameReader) -> dict[str, CameraNoise]:
    """Each camera's noise at the start of a run; cameras with tables of points have no entry."""
    cameras = {name: own for name, own in run.rig.cameras.items() if name in reader.sources}
    out = {name: CameraNoise(name, own.noise, optics=own) for name, own in cameras.items()}
    with ThreadPoolExecutor(picture_source.THREADS) as pool:  # each camera takes up to 40 pictures of memory
        list(pool.map(lambda own: _prepare(own, run, reader.sources[own.camera]), out.values()))
    share_texture(list(out.values()))
    return out


def _prepare(noise: CameraNoise, run: Run, source: PictureSource) -> None:
    """Estimate a camera's noise, and make its static background where that may show more."""
    size_px = run.rig.cameras[noise.camera].image_size_px
    wanted, three = noise_frames(source), successive_frames(source)
    shown = pictures_of_frames(source, sorted({*wanted, *three}), size_px)
    pictures = [p for k in wanted if isinstance(p := shown[k], np.ndarray)]
    noise.estimate_from(pictures)
    successive = [p for k in three if isinstance(p := shown[k], np.ndarray)]
    if noise.estimate is not None:
        noise.kept = kept_of_the_last(successive, noise.estimate.step_dn**2 / 12)
    if noise.shows_structure or noise.sees_motion(pictures, run.tracker.detect):
        if isinstance(source, PictureFiles):
            wanted = evenly_spread(source.numbers, PICTURES).tolist()
        else:
            wanted = list(range(0, VIDEO_FRAMES, VIDEO_FRAMES // PICTURES))
        shown |= pictures_of_frames(source, [k for k in wanted if k not in shown], size_px)
        spread = [shown[k] for k in wanted]
        noise.make_background([p for p in spread if isinstance(p, np.ndarray)], run.tracker.detect)
        if noise.motion is not None:
            numbers = source.numbers if isinstance(source, PictureFiles) else np.arange(VIDEO_FRAMES)
            every = pictures_of_frames(source, evenly_spread(numbers, MOTION_PICTURES).tolist(), size_px)
            usable = {k: p for k, p in every.items() if isinstance(p, np.ndarray)}
            noise.follow_motion(usable, run.tracker.detect)
    else:
        noise.look_for_wide(pictures[::2], run.tracker.detect)
    side = noise.innermost.px
    if side > 1:
        noise.notes.append(
            f"{noise.camera}: speckle makes the spots grainy, so they are measured in sums of {side:.0f}x{side:.0f}"
            " pixels; a wider aperture makes its grains, and the errors, smaller"
        )
    rows = RowCounts()
    for first, second in zip(pictures[::2], pictures[1::2], strict=False):
        rows.add(first, second)
    noise.interlaced = noise.motion is None and rows.interlaced  # structure that a camera moves may alternate, too
    if isinstance(source, PictureFiles):
        source.keep(shown)


def share_texture(cameras: Sequence[CameraNoise]) -> None:
    """Give cameras whose pictures cannot show the texture of the screen or the grain of the light that of the others.

    A background may be too faint, spots may be too narrow. The screens and lasers of a laboratory are alike; without
    this such errors would be taken for noise. Of several textures the finest is taken, of several grains the coarsest.
    """
    cameras = [c.innermost for c in cameras]
    estimates = [c.estimate for c in cameras if c.estimate is not None]
    grains = [c.grain for c in cameras if np.isfinite(c.grain)]
    for camera in cameras:
        if camera.estimate is not None and grains and not np.isfinite(camera.estimate.texture_shift.misfit_share):
            shift = replace(camera.estimate.texture_shift, misfit_share=max(grains))
            camera.estimate = replace(camera.estimate, texture_shift=shift)
    shifts = [e.texture_shift for e in estimates if e.texture_shift.known]
    if not shifts:
        return
    finest = min(shifts, key=lambda s: max(s.light_px)).of_light
    for camera in cameras:
        if camera.estimate is not None and not camera.estimate.texture_shift.known:
            share = camera.estimate.texture_shift.misfit_share
            camera.estimate = replace(camera.estimate, texture_shift=replace(finest, misfit_share=share))


def noise_frames(source: PictureSource) -> list[int]:
    """Numbers of the pictures from which the noise is estimated."""
    if isinstance(source, PictureFiles):
        return [int(source.numbers[i]) for i in noise_estimation_frames(source.count)]
    return list(VIDEO_PICTURES)


def noise_pictures(source: PictureSource) -> list[GreyPicture]:
    """The pictures from which the noise is estimated, as far as they can be read."""
    found = pictures_of_frames(source, noise_frames(source)).values()
    return [p for p in found if not isinstance(p, MissingPicture)]


def successive_frames(source: PictureSource) -> list[int]:
    """Numbers of three successive pictures, of which two serve the estimate of the noise; none in short recordings."""
    if not isinstance(source, PictureFiles):
        return [VIDEO_PICTURES[-2], VIDEO_PICTURES[-1], VIDEO_PICTURES[-1] + 1]
    middle = (source.count - 1) // 2
    return source.numbers[middle : middle + 3].tolist() if source.count > 4 else []


def noise_estimation_frames(pictures: int) -> list[int]:
    """Indices of pairs of neighbouring pictures at the start, in the middle and at the end of a recording.

    The light of neighbours is nearly the same; pairs far apart have their spots in different places.
    """
    last = pictures - 1
    wanted = {0, 1, last // 2, last // 2 + 1, last - 1, last}
    return [i for i in sorted(wanted) if 0 <= i <= last]
