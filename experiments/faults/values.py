"""What may stand where a number, a word or a value does."""

from __future__ import annotations

from typing import Any

import numpy as np

Rng = np.random.Generator

NUMBERS = (
    *("0", "-0", "1", "-1", "2", "7", "0.5", "-0.5", "1e-320", "1e-9", "1e9", "1e38", "3.5e38", "1e308", "-1e308"),
    *("nan", "-nan", "inf", "-inf", "NaN", "Infinity", ".inf", ".nan", "255", "65536", "2147483647", "2147483648"),
    *("1e999", "1e400"),
    *("-2147483649", "4294967296", "9223372036854775807", "9223372036854775808", "0x1F", "0b1", "1_000", "1,5", "1/3"),
    *("\u0661\u0662", "\u00bd", "1e", "1e+", "--1", "+1", ".5", "5.", "true", "false", "null", "None", "", "9" * 400),
    *("9" * 5000, "0." + "0" * 400 + "1"),
)  # fmt: skip
"""What may stand where a number does."""

WORDS = (
    *("", " ", "a" * 300, "a" * 70_000, "..", "/", "/dev/null", "~", "-1", "--help", "[/b]", "[bold]x", "%s"),
    *(
        "%d%n",
        "{0}",
        "{x}",
        "\\",
        "\\x",
        "'",
        '"',
        "a\nb",
        "a\tb",
        "a\rb",
        "\x00",
        "\x1b[31m",
        "ä",
        "漢字",
        "🤖",
        "\u202e",
    ),
    *(
        "$HOME",
        "`id`",
        "*",
        "?",
        "[a-",
        "C:\\x",
        "file:///etc/passwd",
        "http://localhost:1/x",
        "module:Class",
        "os:system",
    ),
    *("../../etc/passwd", "reach", "__main__:X", "nan", "1e999", "true", "x" * 255, "\ufeff", "ﬁ", "\ud7ff", "a b c"),
)
"""What may stand where a word does."""

VALUES: tuple[Any, ...] = (
    *(
        0,
        -1,
        1,
        2,
        3,
        10**6,
        2**31,
        2**32,
        2**53 + 1,
        2**63 - 1,
        10**18,
        -(2**63),
        0.0,
        -0.0,
        0.5,
        1e-320,
        1e308,
        -1e308,
    ),
    *(
        float("nan"),
        float("inf"),
        float("-inf"),
        True,
        False,
        "",
        "x",
        "nan",
        [],
        [[]],
        [0],
        [1, 2, 3],
        [None],
        {},
        {"a": 1},
    ),
)
"""What may stand where any value does."""


def pick(rng: Rng, choices: Any) -> Any:
    """One of some."""
    return choices[int(rng.integers(len(choices)))]
