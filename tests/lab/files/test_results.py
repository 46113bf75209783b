"""Tables read back: large ones by another reader, which must not be noticed."""

from __future__ import annotations

import numpy as np
import pytest

from lab.errors import InputError
from lab.files.run import results
from lab.files.run.results import read_table

NUMBERS, TEXTS = ("frame", "a", "b"), ("word",)


def both_ways(path, monkeypatch, optional=()):
    small = read_table(path, NUMBERS, TEXTS, optional)
    monkeypatch.setattr(results, "_LARGE", 0)
    used = []
    real = results._read_large
    monkeypatch.setattr(results, "_read_large", lambda *a: used.append(real(*a)) or used[-1])
    return small, read_table(path, NUMBERS, TEXTS, optional), used[0] is not None


def test_numbers_words_and_empty_fields_are_the_same_by_both_readers(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    values = np.concatenate([10 ** rng.uniform(-300, 300, 50_000), rng.normal(size=500), [0.1 + 0.2, 5e-324, 1e308]])
    rows = [
        f"{k},{v!r},{'' if k % 3 else 'nan'},{'NA' if k % 2 else 'x y'},more" for k, v in enumerate(values.tolist())
    ]
    path = tmp_path / "t.csv"
    path.write_text("\n".join(["frame,a,b,word,other", *rows]) + "\n")
    one, two, fast = both_ways(path, monkeypatch)
    assert fast
    for name in NUMBERS:
        np.testing.assert_array_equal(one.numbers[name], two.numbers[name])
    assert one.texts["word"].words == two.texts["word"].words == ("x y", "NA")
    np.testing.assert_array_equal(one.texts["word"].codes, two.texts["word"].codes)


def test_a_column_that_may_be_absent_is_unknown_by_both_readers(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    path.write_text("frame,a,word\n1,2,x\n2,3,x\n")
    one, two, fast = both_ways(path, monkeypatch, ("b",))
    assert fast
    for table in (one, two):
        assert np.isnan(table.numbers["b"]).all()
        assert len(table) == 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frame,a,word\n1,2,x\n", "expected a column 'b'"),
        ("frame,a,b,word\n1,2,3,x\n4,5\n", "equal length"),
        ("frame,a,b,word\n1,2,3,x\n4,5,6,7,8\n", "equal length"),
        ("frame,a,b,word\n1,2,five,x\n", "five"),
        ("", "an empty file"),
    ],
)
def test_a_large_table_that_is_wrong_has_the_same_error_as_a_small_one(text, words, tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(InputError) as small:
        read_table(path, NUMBERS, TEXTS)
    monkeypatch.setattr(results, "_LARGE", 0)
    with pytest.raises(InputError) as large:
        read_table(path, NUMBERS, TEXTS)
    assert str(large.value) == str(small.value)
    assert words in str(small.value)
