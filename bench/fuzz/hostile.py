"""Hostile values: fields, texts and bytes that real files contain by accident, and that attackers write on purpose."""

from __future__ import annotations

import random

_BOMB = ", ".join(["*z"] * 10)

# Texts that replace a value in a YAML file, as written.
YAML_TEXTS = (
    "", "~", "true", "no", "0", "-1", "1", "-0.0", "1e300", "-1e300", "1e-300", "5e-324", ".nan", ".inf", "-.inf",
    "9" * 309, "-" + "9" * 400, "9" * 5000, "1e400", "1e16", "9007199254740993", "1_000", "0x1F", "1:30", "2026-02-30",
    "[]", "{}", "[1]", "[1, 2, 3]", "[.nan, 0, 0]", "[1e300, 0, 0]", "[1e-300, 0, 0]", "[0, 0, 0]", "[0, 0, 0, 0]",
    "[a, b, c]", "{a: 1}", "[[1, 2], [3]]", "[" * 80 + "]" * 80, "{a: " * 80 + "1" + "}" * 80,
    "word", "../../../../etc/passwd", "/dev/zero", ".", "..", "/", "a" * 5000, "=1+1", "'=cmd()'", "'@SUM(A1)'",
    "'+x'", "'-1+cmd(1)'", "'<script>alert(1)</script>'", '"\\ud800"', '"\\0"', '"\\e[2J"', '"\\r\\n"', '"\\u202e"',
    "!!int abc", "!!float abc", "!!bool 7", "!!timestamp x", "!!set {a}", "!!binary x", "!!python/object:os.system x",
    "!!int [1]", "!!map 3", "!!seq 3", "!!str {a: 1}", "!!opencv-matrix 3", "*nothing", "&q [*q]", "<<: 1", "| text",
    "'", '"', "@", "`", "%", "{", "[", "- -", "a: b", "\tx", "'caf\u00e9'", "\u2028", "\ufeff",
    f"[&z [x, x, x, x, x, x, x, x, x, x], &y [{_BOMB}], &w [{_BOMB.replace('z', 'y')}],"
    f" &v [{_BOMB.replace('z', 'w')}], &u [{_BOMB.replace('z', 'v')}], [{_BOMB.replace('z', 'u')}]]",
)  # fmt: skip

# Fields of a CSV table, as written.
CSV_FIELDS = (
    "", " ", "nan", "inf", "-inf", "1e300", "-1e300", "1e-300", "5e-324", "1e400", "9" * 400, "-1", "0", "1.5", "1_0",
    "0x10", "1,2", '"', '"a', "word", "=cmd()", "@x", "+1", "-1", "\x00", "\x1b[2J", "\u202e",
    "caf\u00e9", "a" * 200_000,
    "9007199254740993", "1;2", "1\t2", "true", "-0", "1e15", "9223372036854775808", "2147483648", "NaN", "None",
)  # fmt: skip

# Values of options of the command line.
OPTION_VALUES = (
    "nan", "inf", "-inf", "1e300", "-1e300", "1e-300", "5e-324", "0", "-0", "-1", "1", "0.5", "9" * 400, "9" * 5000, "",
    " ", "word", "true", "[]", "{}", "[" * 500, "{a: " * 70, "~", "1e-3", "[1, 2]", "'", "=1", "\x1b[2J", "\udcff",
    "caf\u00e9", "../..", "*x", "&x [*x]", "!!int x", "1:2", "1e9", "99999999",
)  # fmt: skip


def some_bytes(rng: random.Random) -> bytes:
    """Bytes to insert anywhere."""
    return rng.choice(
        (
            b"\x00", b"\xff", b"\xfe\xff", b"\xef\xbb\xbf", b"\xed\xa0\x80", b"\x1b[2J", b"\r", b"\n\n", b"\t", b",",
            b"'",
            b'"', b":", b"#", b"- ", b"%", rng.randbytes(rng.randint(1, 16)), b"\x80" * 50, b"9" * 400, b"[" * 300,
        )
    )  # fmt: skip
