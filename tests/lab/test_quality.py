"""The verdict on a run: each gate on both sides of its limit, and one exit status for it."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from lab.quality import GOOD_MEASURED, LEAST_MEASURED, Verdict, judge


def judged(
    frames: int = 1000,
    measured: int = 1000,
    lost: int = 0,
    misfit: float = 1.0,
    no_image: Mapping[str, int] | None = None,
    ties: int = 0,
    again: int = 0,
) -> Verdict:
    return judge(frames, measured, lost, misfit, no_image or {}, ties, again)


def test_a_clean_run_passes_and_says_why():
    verdict = judged()
    assert (verdict.status, verdict.exit_status) == ("pass", 0)
    assert verdict.reasons == (
        "100.0% of the frames have a measured pose, and the residuals are what the sigmas allow",
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
    assert judged(measured=measured).status == status


@pytest.mark.parametrize(
    ("misfit", "status"), [(1.0, "pass"), (1.5, "pass"), (1.6, "check"), (5.0, "check"), (5.1, "fail")]
)
def test_the_misfit_of_the_rig_decides(misfit, status):
    verdict = judged(misfit=misfit)
    assert verdict.status == status
    if status != "pass":
        assert f"{misfit:.1f} times as far" in verdict.reasons[0]


def test_no_frame_at_all_is_a_failure():
    verdict = judged(frames=0, measured=0)
    assert verdict.status == "fail"
    assert verdict.reasons == ("there is no frame at all",)


def test_a_vehicle_that_was_never_found_is_a_failure_in_plain_words():
    assert judged(measured=0, lost=1000).reasons[0] == "the vehicle was never found: no frame has a measured pose"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"no_image": {"left": 51, "right": 10}}, "camera left has no usable picture in 51 of 1000 frames"),
        ({"ties": 1}, "explained in two ways"),
        ({"lost": 3}, "nothing is known of the vehicle in 3 frames"),
        ({"again": 2}, "found again 2 times"),
    ],
)
def test_what_wants_looking_at_is_a_doubt_and_not_a_failure(arguments, words):
    verdict = judged(**arguments)
    assert (verdict.status, verdict.exit_status) == ("check", 0)
    assert len(verdict.reasons) == 1
    assert words in verdict.reasons[0]


def test_a_few_missing_pictures_are_no_doubt():
    assert judged(no_image={"left": 50}).status == "pass"


def test_failures_come_before_doubts_and_none_is_left_out():
    verdict = judged(measured=100, lost=900, misfit=6.0, ties=1)
    assert verdict.status == "fail"
    assert verdict.exit_status == 4
    assert [any(word in r for r in verdict.reasons) for word in ("only 10%", "6.0 times", "two ways", "900")] == [
        True
    ] * 4
    assert verdict.reasons[0].startswith("only 10%")
    assert "6.0 times" in verdict.reasons[1]


def test_the_exit_status_is_4_exactly_for_failures():
    assert [Verdict(s, ()).exit_status for s in ("pass", "check", "fail")] == [0, 0, 4]
