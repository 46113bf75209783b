"""The options of `beampose compare`."""

from __future__ import annotations

import pytest

from tests.lab.command import typed
from tests.lab.results.compare.test_compare import SIMPLE, write_results, write_tum
from tests.tracking.comparison.motions import recordings


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--align", "tme"), "expected all, none or some of time,rate,world,body, got 'tme'"),
        (("--align", "rate"), "rate needs time too"),
        (("--sigma-m", "-1"), "not in the range"),
        (("--sigma-deg", "nan"), "expected a finite number"),
        (("--offset", "1e300"), "not in the range"),
        (("--reference", "nowhere.csv"), "does not exist"),
        ((), "expected a second result folder or --reference FILE"),
    ],
)
def test_a_wrong_option_is_exit_status_2(tmp_path, options, words):
    result = write_results(tmp_path / "one", recordings(1)[0])
    done = typed("compare", result, *options)
    assert done.exit_code == 2
    assert words in done.stderr


def test_a_comparison_without_out_prints_and_writes_nothing(tmp_path):
    mine, theirs = recordings(1)
    result, reference = write_results(tmp_path / "one", mine), write_tum(tmp_path / "other.tum", theirs)
    before = sorted(tmp_path.rglob("*"))
    done = typed("compare", result, "--reference", reference, "--align", "all")
    assert done.exit_code == 0, done.output
    assert "chi-square per degree of freedom" in done.stdout
    assert sorted(tmp_path.rglob("*")) == before


def test_a_result_is_compared_with_itself_in_readable_numbers(tmp_path):
    """Rounding errors printed thirty zeros."""
    result = write_results(tmp_path / "one", recordings(1)[0])
    done = typed("compare", result, result)
    assert done.exit_code == 0, done.output
    assert "chi-square per degree of freedom" in done.stdout
    assert "000000" not in done.stdout


def test_how_many_frames_are_within_their_limit_is_stated_against_a_reference_alone(tmp_path):
    """The errors of two results can have the same causes, so that no share of them is to be expected."""
    mine, theirs = recordings(1, truth=SIMPLE)
    one, two = write_results(tmp_path / "one", mine), write_results(tmp_path / "two", mine)
    reference = write_tum(tmp_path / "other.tum", theirs)
    share = "of the frames within the 95 % limit"
    assert share in typed("compare", one, "--reference", reference).stdout
    done = typed("compare", one, two)
    assert done.exit_code == 0, done.output
    assert share not in done.stdout
