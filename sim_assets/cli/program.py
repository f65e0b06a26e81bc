# SPDX-License-Identifier: MIT
"""The words of a `scapo-data` command to its verb, and errors to one line."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated, Any, Union

import tyro
from rich.console import Console

from scapo.interrupt import exit_if_unheard, exit_interrupted
from scapo.ranges import check_numbers
from scapo.text import UsageError, empty_flag, unknown_word, words_of
from sim_assets.cli.console import say
from sim_assets.cli.verbs import VERBS

DESCRIPTION = (
    "Make and look at labelled point clouds of articulated objects (--version: of which release)."
)


def _commands() -> Any:  # noqa: ANN401 - a union made at run time
    commands = [Annotated[verb, tyro.conf.subcommand(name)] for name, verb in VERBS.items()]
    return Union[tuple(commands)]  # noqa: UP007 - the tuple is not known to the type checker


def _joined(words: Sequence[str]) -> list[str]:
    """`--front -x` as `--front=-x`, since a word that begins with a dash is read as a flag."""
    found: list[str] = []
    for word in words:
        if found and found[-1] in ("--up", "--front") and word in ("-x", "-y", "-z"):
            found[-1] += f"={word}"
        else:
            found.append(word)
    return found


def run(arguments: Sequence[str] | None = None) -> None:
    """Run one verb and end by `SystemExit`."""
    console, errors = Console(), Console(stderr=True)
    words = _joined(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        say(console, f"scapo-data {version('scapo')}")
        sys.exit(0)
    try:
        if words and not words[0].startswith("-") and words[0] not in VERBS:
            raise UsageError(unknown_word("verb", words[0], VERBS))
        if said := empty_flag(words, ["--only"]):
            raise UsageError(said)
        command: Any = tyro.cli(
            _commands(),
            prog="scapo-data",
            description=DESCRIPTION,
            args=words,
            config=(tyro.conf.OmitArgPrefixes,),
        )
        check_numbers(command)
        sys.exit(command.run(console))
    except MemoryError as error:
        say(errors, f"scapo-data: expected enough memory, found: {error}")
        sys.exit(1)
    except (ValueError, OSError, RuntimeError) as error:
        if isinstance(error, BrokenPipeError):
            exit_if_unheard()
        say(errors, f"scapo-data: {words_of(error)}")
        sys.exit(2 if isinstance(error, UsageError) else 1)
    except KeyboardInterrupt:
        say(errors, "scapo-data: stopped; the same command takes it up where it was")
        exit_interrupted()
