"""The verdict on a run: each gate on both sides of its limit, its reasons, and its exit status."""

from __future__ import annotations

from collections import Counter

import pytest

from lab.findings.finding import Finding, Level, Verdict, entries, finding
from lab.runs.frames.sensor_noise import CameraNoise
from lab.runs.verdict.moved_camera import FEWEST_FRAMES, MovedCamera, ShownSpots
from lab.runs.verdict.quality import GOOD_MEASURED, LEAST_MEASURED, LEAST_MEASURED_OF_SHOWN, judge
from lab.runs.verdict.run_statistics import MISSED, CameraStatistics, FrameCause, FrameRanges, RunStatistics

FRAMES = 1000


def pictures_of(camera: str, **shown: float) -> dict[str, CameraNoise]:
    """What the pictures of a camera show besides spots."""
    noise = CameraNoise(camera)
    for name, value in shown.items():
        setattr(noise, name, value)
    return {camera: noise}


def ranges(*spans: tuple[int, int]) -> FrameRanges:
    return FrameRanges([list(s) for s in spans])


def a_camera(**changed: object) -> CameraStatistics:
    """A camera with a picture in each frame and three points in each."""
    camera = CameraStatistics(pictures=FRAMES, points=3 * FRAMES, expected=3 * FRAMES, found=3 * FRAMES)
    for name, value in changed.items():
        setattr(camera, name, value)
    return camera


def statistics_of(
    measured: int = FRAMES,
    causes: dict[FrameCause, int] | None = None,
    cameras: dict[str, CameraStatistics] | None = None,
    **changed: object,
) -> RunStatistics:
    """Frames 0 to 999; those without a measurement are predicted, by default because of hidden spots."""
    cameras = cameras or {"left": a_camera(), "right": a_camera()}
    statistics = RunStatistics(cameras, frames=FRAMES, last_frame=FRAMES - 1)
    statistics.pose = Counter({"measured": measured, "predicted": FRAMES - measured})
    statistics._surplus[0] = measured
    if causes is None:
        causes = {FrameCause.HIDDEN: FRAMES - measured} if measured < FRAMES else {}
    statistics._causes.update({(cause, 0): count for cause, count in causes.items()})
    for name, value in changed.items():
        setattr(statistics, name, value)
    return statistics


def kinds(verdict: Verdict) -> list[str]:
    return [entries()[e.code].kind for e in verdict.findings]


def test_a_clean_run_passes_and_gives_the_reason():
    verdict = judge(statistics_of())
    assert (verdict.status, verdict.exit_status, verdict.findings) == ("pass", 0, ())
    assert verdict.texts == (
        "100.0% of the frames have a measured pose, and the residuals agree with the stated sigmas",
    )


@pytest.mark.parametrize(
    ("measured", "status"),
    [
        (1000, "pass"),
        (int(1000 * GOOD_MEASURED), "pass"),
        (int(1000 * GOOD_MEASURED) - 1, "check"),
        (int(1000 * LEAST_MEASURED), "check"),
        (int(1000 * LEAST_MEASURED) - 1, "fail"),
        (0, "fail"),
    ],
)
def test_the_share_of_measured_frames_decides(measured, status):
    assert judge(statistics_of(measured)).status == status


@pytest.mark.parametrize("cause", FrameCause)
def test_only_missed_frames_fail_a_run_and_frames_with_too_few_spots_do_not(cause):
    """The results of a long occlusion are correct; visible spots that no pose explains are not a measurement."""
    measured = int(FRAMES * LEAST_MEASURED_OF_SHOWN) - 1
    verdict = judge(statistics_of(measured, {cause: FRAMES - measured}))
    assert verdict.status == ("fail" if cause in MISSED else "check")
    assert kinds(verdict) == ["few_measured"]
    assert cause.meaning in verdict.texts[0]
    assert verdict.findings[0].remedy == entries()["BP-V03"].variant(cause.value).remedy


def test_the_share_of_missed_frames_is_relative_to_the_frames_with_enough_spots():
    """200 measured, 190 missed, 610 occluded: most frames with visible spots were measured."""
    verdict = judge(statistics_of(200, {FrameCause.UNEXPLAINED: 190, FrameCause.HIDDEN: 610}))
    assert verdict.status == "check"
    assert "of the others, 610 with hidden spots, 190 with enough points of light" in verdict.texts[0]
    assert judge(statistics_of(200, {FrameCause.UNEXPLAINED: 210, FrameCause.HIDDEN: 590})).exit_status == 4


@pytest.mark.parametrize(
    ("noise_scale", "status"), [(1.0, "pass"), (1.5, "pass"), (1.6, "check"), (5.0, "check"), (5.1, "fail")]
)
def test_the_noise_scale_decides_where_the_model_check_has_not_tested(noise_scale, status):
    verdict = judge(statistics_of(), noise_scale=noise_scale)
    assert verdict.status == status
    if status != "pass":
        assert f"{noise_scale:.1f} times as far" in verdict.texts[0]


def test_a_run_without_frames_is_a_failure():
    verdict = judge(RunStatistics({"left": CameraStatistics()}))
    assert verdict.status == "fail"
    assert verdict.texts == ("there is no frame at all",)


# -- why the vehicle was never found ----------------------------------------------------------------------------------


def never(**changed: object) -> Verdict:
    arguments: dict[str, object] = {"causes": {FrameCause.UNEXPLAINED: FRAMES}} | changed
    # mypy cannot know which argument each keyword is for.
    verdict = judge(statistics_of(0, **arguments))  # type: ignore[arg-type]
    assert verdict.exit_status == 4
    assert verdict.texts[0] == "the vehicle was never found: no frame has a measured pose"
    assert all(e.level is Level.FAIL and e.remedy for e in verdict.findings)
    assert verdict.remedy == verdict.findings[1].remedy
    return verdict


def test_points_that_no_pose_explains_suggest_a_wrong_prior_or_rig():
    verdict = never()
    assert kinds(verdict) == ["never_found", "not_acquired"]
    assert "3.0 per picture in camera left" in verdict.texts[1]
    assert "prior" in verdict.remedy


def test_a_camera_without_any_detection_is_the_only_reason():
    unlit = a_camera(points=0, empty=FRAMES, expected=0, found=0)
    verdict = never(cameras={"left": a_camera(), "right": unlit})
    assert kinds(verdict) == ["never_found", "nothing_detected"]
    assert verdict.texts[1] == "camera right: nothing was detected in any of its 1000 pictures"
    assert "lens uncovered" in verdict.remedy


def test_a_camera_without_any_picture_is_reported():
    gone = CameraStatistics(missing=ranges((0, FRAMES - 1)))
    verdict = never(cameras={"left": a_camera(), "right": gone}, causes={FrameCause.NO_PICTURE: FRAMES})
    assert kinds(verdict) == ["never_found", "no_pictures"]
    assert verdict.texts[1] == "camera right has no usable picture at all"


def test_too_few_points_are_distinguished_from_points_that_do_not_fit():
    verdict = never(causes={FrameCause.FEW_POINTS: 950, FrameCause.UNEXPLAINED: 50})
    assert kinds(verdict) == ["never_found", "few_points"]
    assert "950 frames of 1000 show fewer than the 4 points" in verdict.texts[1]


def test_a_tie_is_reported_with_its_candidates():
    verdict = never(ties=ranges((3, 3)), tie_text="spots 1, 2 or spots 2, 3")
    assert kinds(verdict) == ["never_found", "ambiguous"]
    assert verdict.texts[1] == "the spots fit more than one pose. Spots 1, 2 or spots 2, 3"
    assert "spots 1, 2" not in verdict.of_frames(0, FRAMES).lower()
    assert "narrower" in verdict.remedy


def test_frames_that_do_not_determine_the_pose_are_the_reason_without_any_other():
    verdict = never(causes={FrameCause.NOT_DETERMINED: 700, FrameCause.OUT_OF_VIEW: 300})
    assert verdict.texts[1].startswith("of 1000 frames, 700 whose spots do not determine the pose, 300 with fewer")
    assert "two screens" in verdict.remedy


def test_a_run_that_only_the_causal_pass_measured_is_reported_as_not_confirmed():
    verdict = never(causal_measured=98, lost=ranges((0, 999)), found_again=0)
    assert kinds(verdict)[:2] == ["never_found", "not_confirmed"]
    assert "98 of 1000 frames" in verdict.texts[1]
    assert not any("found again" in r and "not found again" not in r for r in verdict.texts)


# -- points to check --------------------------------------------------------------------------------------------------


def with_missing(*spans: tuple[int, int]) -> dict[str, CameraStatistics]:
    missing = ranges(*spans)
    return {"left": a_camera(pictures=FRAMES - len(missing), missing=missing), "right": a_camera()}


@pytest.mark.parametrize(
    ("changed", "kind", "words"),
    [
        (
            {"cameras": with_missing((100, 150))},
            "missing_pictures",
            "camera left has no usable picture in 51 of",
        ),
        (
            {"cameras": with_missing((990, 999))},
            "camera_stopped",
            "camera left stopped before the end: it has no picture from frame 990 on (10 frames)",
        ),
        (
            {"cameras": with_missing((0, 0))},
            "camera_late",
            "starts late: it has no picture of the first 1 frame",
        ),
        (
            {"ties": ranges((7, 7)), "tie_text": "A or B"},
            "ambiguous",
            "frame 7 could be explained in more than",
        ),
        (
            {"lost": ranges((10, 12)), "found_again": 1},
            "lost",
            "the vehicle was lost in 3 frames (10 to 12); it was found again",
        ),
        ({"lost": ranges((990, 999))}, "lost", "10 frames (990 to 999); it was not found again"),
        ({"own_spots": ranges((5, 6))}, "contradiction", "2 frames (5 to 6) contradict their own spots"),
        ({"causal": ranges((5, 5))}, "contradiction", "1 frame (5) contradict the causal pass"),
        ({"invalid": ranges((5, 5))}, "internal", "covariances of 1 frame (5) are not positive definite"),
    ],
)
def test_a_point_to_check_has_a_remedy_and_is_not_a_failure(changed, kind, words):
    verdict = judge(statistics_of(**changed))
    assert (verdict.status, verdict.exit_status) == ("check", 0)
    assert kinds(verdict) == [kind]
    assert words in verdict.texts[0]
    assert verdict.findings[0].remedy
    assert verdict.remedy == ""  # nothing failed


def test_a_few_missing_pictures_are_not_reported():
    assert judge(statistics_of(cameras=with_missing((100, 149)))).status == "pass"


def test_a_camera_without_detections_at_the_end_is_reported_if_spots_are_expected_there():
    empty = {"empty": 100, "empty_at_end": 100}
    seen = judge(statistics_of(cameras={"left": a_camera(**empty, expected_at_end=300), "right": a_camera()}))
    assert kinds(seen) == ["nothing_detected"]
    assert "in its last 100 pictures, where the pose puts spots inside them" in seen.texts[0]
    nothing_expected = judge(statistics_of(cameras={"left": a_camera(**empty), "right": a_camera()}))
    assert nothing_expected.status == "pass"


def test_findings_of_the_model_check_count_by_their_level_and_keep_their_remedy():
    found = [finding("BP-M01", level, "camera `right` may have moved", why="It turns the pose.") for level in Level]
    verdict = judge(statistics_of(), found)
    remedy = entries()["BP-M01"].remedy
    assert [(e.code, e.level, e.remedy) for e in verdict.findings] == [
        ("BP-M01", Level.FAIL, remedy),
        ("BP-M01", Level.WARN, remedy),
    ]
    assert kinds(verdict) == ["model", "model"]
    assert verdict.texts[0] == "camera `right` may have moved. It turns the pose"


def test_failures_come_before_points_to_check():
    statistics = statistics_of(300, {FrameCause.UNEXPLAINED: 700}, lost=ranges((100, 999)), own_spots=ranges((7, 7)))
    verdict = judge(statistics, noise_scale=6.0)
    assert verdict.exit_status == 4
    assert [e.level is Level.FAIL for e in verdict.findings] == [True, True, False, False]
    assert [any(word in r for r in verdict.texts) for word in ("only 30%", "6.0 times", "900", "contradict")] == [
        True
    ] * 4


def test_every_kind_of_reason_and_every_cause_has_a_remedy():
    assert set(entries()["BP-V03"].variants) == {cause.value for cause in FrameCause}
    assert all(entry.remedy for entry in entries().values())


def test_a_reason_is_written_as_plain_values():
    (reason,) = judge(statistics_of(cameras=with_missing((990, 999)))).findings
    mapping = reason.as_mapping()
    assert list(mapping) == ["kind", "code", "level", "what", "why", "remedy", "numbers"]
    assert (mapping["kind"], mapping["level"]) == ("camera_stopped", "check")
    assert mapping["numbers"] == {"camera": "left", "missing": [[990, 999]]}


def test_the_exit_status_is_4_exactly_for_failures():
    assert [Verdict((Finding(level, ""),)).exit_status for level in Level] == [0, 0, 4]


def test_raw_pictures_of_a_colour_camera_are_a_point_to_check():
    verdict = judge(statistics_of(), noise=pictures_of("left", mosaic=0.2))
    assert (verdict.status, kinds(verdict)[0]) == ("check", "colour_mosaic")
    assert "camera left" in verdict.texts[0]
    assert "20%" in verdict.texts[0]
    assert verdict.exit_status == 0


@pytest.mark.parametrize(("frames", "status"), [(FEWEST_FRAMES - 1, "pass"), (FEWEST_FRAMES, "check")])
def test_a_camera_that_moved_during_the_recording_is_a_point_to_check(frames, status):
    spots = ShownSpots()
    for frame in range(500 + frames):
        spots.frames.append(frame)
        spots.expected.append(3)
        spots.used.append(3 if frame < 500 else 0)
        spots.points.append(3)
    cameras = {"left": a_camera(spots=spots), "right": a_camera()}
    verdict = judge(statistics_of(cameras=cameras))
    assert verdict.status == status
    if status == "check":
        assert kinds(verdict) == ["camera_moved"]
        assert "camera left: in 5 frames (500 to 504)" in verdict.texts[0]


@pytest.mark.parametrize(("moved", "status"), [(MovedCamera(40, "left", True), "check"), (MovedCamera(40, ""), "fail")])
def test_a_movement_fails_where_it_is_not_known_which_camera_to_leave_out(moved, status):
    statistics = statistics_of(cameras={"left": a_camera(), "right": a_camera()})
    statistics.moved = moved
    verdict = judge(statistics)
    assert (verdict.status, kinds(verdict)) == (status, ["camera_moved"])
    assert "frame 40" in verdict.texts[0]


@pytest.mark.parametrize(("kept", "status"), [(0.008, "pass"), (0.5, "check"), (float("nan"), "check")])
def test_spots_that_are_longer_along_a_slow_motion_are_no_averages_where_the_noise_shows_none(kept, status):
    """Texture of the screen deforms the spot in successive pictures alike. nan: the noise shows nothing."""
    verdict = judge(statistics_of(), noise=pictures_of("left", kept=kept), stretch={"left": (2.1, 0.3)})
    assert verdict.status == status


def test_a_colour_mosaic_comes_before_the_misfit_that_it_explains():
    moved = Finding(Level.FAIL, "camera `left` may have moved", why="averaging does not help", code="BP-M01")
    verdict = judge(statistics_of(), [moved], noise=pictures_of("left", mosaic=0.5))
    assert kinds(verdict) == ["colour_mosaic", "model"]
    assert "demosaicing" in verdict.of_frames(FRAMES, FRAMES)
    assert verdict.texts[1] == "camera `left` may have moved. Averaging does not help"


def test_a_light_that_is_too_wide_is_no_reason_where_another_camera_shows_nothing():
    """Without any pose no spot of any camera has a label: that of a spot is then not missing for its width."""
    cameras = {"left": a_camera(points=0, empty=FRAMES, found=0), "right": a_camera(found=0)}
    nothing = statistics_of(0, {FrameCause.FEW_POINTS: FRAMES}, cameras)
    nothing.spot_status = {("left", "1"): Counter(), ("right", "2"): Counter()}
    found = judge(nothing, noise=pictures_of("right", too_wide_px=32.0))
    assert "BP-V21" not in {f.code for f in found.findings}
    assert "BP-V08" in {f.code for f in found.findings}
    of_itself = judge(nothing, noise=pictures_of("left", too_wide_px=32.0))  # its only light may be the spot
    assert of_itself.findings[0].code == "BP-V21"
