# SPDX-License-Identifier: MIT
"""Names and messages that came from outside, made fit for a terminal, a table or a spreadsheet.

What a file says of itself may hold line breaks, escape sequences, markup or a megabyte of text.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches

LONGEST = 2000
"""Characters of a message; of longer text the middle is left out."""
LONGEST_WORD = 200
"""Characters of a name that is also a folder's."""
_FORMULA = re.compile(r"'*[=+\-@\t\r]")
"""What a spreadsheet would compute, after any number of the quotes that prevent it."""


class UsageError(ValueError):
    """Words of a command that a parser could not know to be wrong: it ends 2, as a refusal does."""


def one_line(text: object, longest: int = LONGEST) -> str:
    r"""Text on one line, without what a terminal would obey, at most `longest` characters.

    >>> one_line("a\nb \x1b[31mred\x9b2J")
    'a b \\x1b[31mred\\x9b2J'
    >>> one_line("x" * 50, 20)
    'xxxxxxxxxxx … xxxxxx'
    """
    line = _shortened(str(text), longest)
    line = " ".join(part.strip() for part in line.splitlines() if part.strip())
    if line.isprintable():
        return line
    shown = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    return _shortened("".join(shown), longest)


def _shortened(text: str, longest: int) -> str:
    if len(text) <= longest:
        return text
    tail = longest // 3
    return f"{text[: longest - tail - 3]} … {text[len(text) - tail :]}"


def words_of(error: Exception) -> str:
    """What an error says; of a file that the system refused: where, what was expected, what came.

    >>> words_of(PermissionError(13, "Permission denied", "out"))
    'out: expected a place that can be read or written, found: Permission denied'
    >>> words_of(ValueError("points: expected 3, found 2"))
    'points: expected 3, found 2'
    >>> words_of(FileExistsError(17, "File exists", "out"))
    'out: expected a folder, found a file'
    """
    if isinstance(error, OSError) and error.strerror and error.filename:
        if isinstance(error, FileExistsError):  # what `mkdir` says where the folder is a file
            return f"{error.filename}: expected a folder, found a file"
        reason = error.strerror
        return f"{error.filename}: expected a place that can be read or written, found: {reason}"
    return str(error)


def is_word(text: str) -> bool:
    r"""Whether a name from outside can be that of a folder, and nothing but that.

    >>> is_word("laptop"), is_word("../x"), is_word("a/b"), is_word("a\nb"), is_word("..")
    (True, False, False, False, False)
    """
    plain = text.isprintable() and not set(text) & set("/\\")
    return plain and 0 < len(text) <= LONGEST_WORD and not text.startswith(".")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The end of a message about a name that is not known, where one that is looks like it.

    >>> did_you_mean("lapto", ["oven", "laptop"]), did_you_mean("teapot", ["oven"])
    ("; did you mean 'laptop'?", '')
    """
    close = get_close_matches(name[:LONGEST_WORD].lower(), list(known), 1)
    return f"; did you mean {close[0]!r}?" if close else ""


def unknown_word(kind: str, word: str, known: Iterable[str]) -> str:
    """What to say of a word of a command that is none of those that there are.

    >>> unknown_word("verb", "trian", ["train", "predict"])
    "verb 'trian': expected one of train, predict, found none; did you mean 'train'?"
    """
    names = list(known)
    expected = f"expected one of {', '.join(names)}, found none"
    return f"{kind} {word!r}: {expected}{did_you_mean(word, names)}"


def empty_flag(words: Sequence[str], several: Iterable[str]) -> str | None:
    """What to say of a command whose flag has nothing to it, as "$UNSET" or $UNSET gives it one.

    Args:
        words: Of the command.
        several: Flags that take any number of words, which would then be all that there are.

    >>> empty_flag(["run", "--out", "", "--only"], ["--only"])
    '--out: expected a value, found none'
    >>> empty_flag(["run", "--only", "--out", "x"], ["--only"])
    '--only: expected a value, found none'
    >>> empty_flag([], ["--only"])
    """
    listed = set(several)
    for word, after in zip(words, [*words, "--"][1:], strict=True):
        none = not after or word.endswith("=") or (word in listed and after.startswith("--"))
        if word.startswith("--") and none:
            return f"{word.rstrip('=')}: expected a value, found none"
    return None


def as_cell(text: str) -> str:
    """A text cell of a CSV file that no spreadsheet takes for a formula; `from_cell` undoes it.

    >>> as_cell("=1+1"), as_cell("scapo"), from_cell(as_cell("'-x"))
    ("'=1+1", 'scapo', "'-x")
    """
    return f"'{text}" if _FORMULA.match(text) else text


def from_cell(cell: str) -> str:
    """The text of a cell that `as_cell` wrote."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def csv_text(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    r"""A table as CSV, its heading first.

    >>> csv_text(["a", "b"], [(1, "x,y")])
    'a,b\n1,"x,y"\n'
    """
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([columns, *rows])
    return buffer.getvalue()


def as_markdown(text: str) -> str:
    r"""Text of a Markdown table or list, without HTML, links and column marks of its own.

    >>> as_markdown("a|b <img src=x> [c](d) R&D")
    'a\\|b &lt;img src=x&gt; [c]\\(d) R&amp;D'
    >>> print(as_markdown("a\\|b"))
    a\\\|b
    """
    line = (
        one_line(text)
        .replace("\\", "\\\\")
        .replace("&", "&amp;")
        .replace("<", "&lt;")
        .replace(">", "&gt;")
    )
    return line.replace("|", "\\|").replace("](", "]\\(")
