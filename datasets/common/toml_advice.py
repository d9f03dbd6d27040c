"""Advice on a line that is not valid TOML: habits of other languages, of spreadsheets and of word processors.

The parser says where it stopped, and only that line is looked at.
"""

from __future__ import annotations

import re

_PLACE = re.compile(r"\(at line (\d+), column \d+\)")
_KEY = r"^\s*[\w.\"'-]+\s*=\s*"
_HABITS = (
    (r"[\u200b\u200c\u200d\u2060\ufeff\u00a0\u2007\u202f]", "the line has a sign that is not seen: type it anew"),
    (r"[\u201c\u201d\u201e\u00ab\u00bb\u2018\u2019]", "quotes are straight ones, \" or '"),
    (r"[\u2212\u2013\u2014]", "minus is the sign - of the keyboard"),
    (r"[\uff10-\uff19\u0660-\u0669]", "digits are 0 to 9 of the keyboard"),
    (r"[\x00-\x08\x0b-\x1f\x7f]", "the line has a control character: type it anew"),
    (r"^\s*```|^\s*>", "copy the lines of the example without the marks around them"),
    (_KEY + r"(True|False)\b", "TOML writes true and false in small letters"),
    (_KEY + r"(None|null|nil|NULL|undefined)\b", "TOML has no empty value: leave the key out"),
    (_KEY + r"NaN\b|" + _KEY + r"[-+]?(Inf|inf(inity)?|Infinity)\b", "a number is needed"),
    (_KEY + r"[-+]?\d+,\d+\s*(#.*)?$", "numbers have a decimal point, no comma"),
    (_KEY + r"[-+]?\d{1,3}([ ',]\d{3})+", "numbers have no mark between thousands"),
    (_KEY + r"[-+]?\.\d", "a digit stands before the decimal point"),
    (_KEY + r"[-+]?\d+\.(\s|$|#|e|E)", "a digit stands after the decimal point"),
    (_KEY + r"[-+]?0\d", "a whole number has no zero before it"),
    (_KEY + r"[-+]?[\d.]+[dD][-+]?\d", "a power of ten is written with e, as 5e-2"),
    (_KEY + r"[-+]?[\d.eE+-]+\s*(\u00b1|\+-|\+/-)", "a value stands alone, without its uncertainty"),
    (_KEY + r"[-+]?[\d.eE+-]+\s*(//|;|--|%|/\*)", "one value a line; a remark begins with #"),
    (_KEY + r"[-+]?[\d.eE+-]+\s*[*/]", "a number is written out: nothing is computed"),
    (_KEY + r"[-+]?[\d.eE+-]+[ \t]*([a-zA-Z\u00b5\u00b0]+)\s*(#.*)?$", "a number has no unit: its key ends with it"),
    (_KEY + r"[-+]?[\d.eE+-]+\s*,?\s*\w+\s*=", "each key has a line of its own"),
    (_KEY + r"\(", "a list stands in square brackets, [ and ]"),
    (_KEY + r"([A-Za-z_][\w.]*)\s*(#.*)?$", "a text stands in quotes"),
    (_KEY + r"$", "a value stands after ="),
    (r"^\s*\[.*\]\s*;", "no semicolon stands at the end of a line"),
    (r"^\s*\w+\s*:", "between key and value stands =, no colon"),
    (r"^\s*\w+[ \t]+\w+\s*=", "a key is one word"),
    (r"^\s*(//|;|--|%|/\*)", "a remark begins with #"),
)  # fmt: skip


def toml_advice(text: str, reason: str) -> str:
    """Advice on a text that `tomllib` refused.

    Parameters
    ----------
    text : str
        All of the file.
    reason : str
        The parser's sentence, with the line.

    Returns
    -------
    str
        "" where nothing is known.
    """
    if "Cannot overwrite" in reason or "Cannot declare" in reason or "Cannot mutate" in reason:
        return "a key or table stands twice: keep one of them"
    place = _PLACE.search(reason)
    lines = text.split("\n")
    number = int(place[1]) if place is not None else len(lines)
    # a value that goes on in the next line is refused there; only a line's beginning is looked at
    line = next((one for one in reversed(lines[:number]) if one.strip()), "")[:400].rstrip("\r")
    return next((advice for habit, advice in _HABITS if re.search(habit, line)), "")
