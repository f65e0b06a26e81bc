# SPDX-License-Identifier: MIT
"""The words of a `scapo-bench` command to its verb, and errors to one line."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated, Any, Union

import tyro
from rich.console import Console
from rich.logging import RichHandler

from bench.cli.console import say
from bench.cli.verbs import VERBS, prepare, train_verb
from scapo.interrupt import exit_if_unheard, exit_interrupted
from scapo.ranges import check_numbers
from scapo.text import UsageError, empty_flag, unknown_word, words_of

DESCRIPTION = (
    "Train, predict, score and tabulate methods of articulated pose estimation "
    "(--version: of which release)."
)


def _commands(words: Sequence[str], preset: str | None) -> Any:  # noqa: ANN401 - made at run time
    verbs = dict(VERBS)
    if "train" in words:  # its methods, whose flags are the next level, take seconds to import
        verbs["train"] = train_verb(preset)
    commands = [Annotated[verb, tyro.conf.subcommand(name)] for name, verb in verbs.items()]
    return Union[tuple(commands)]  # noqa: UP007 - the tuple is not known to the type checker


def _check_words(words: Sequence[str]) -> None:
    """Refuse a verb or a method that is none, and a flag with nothing to it.

    Raises:
        UsageError: Naming those that there are, the one that looks like it, or the flag.
    """
    kinds = [("verb", VERBS)]
    if words[:1] == ["train"]:
        from bench.methods import all_methods

        kinds.append(("method", all_methods()))
    for word, (kind, known) in zip(words, kinds, strict=False):
        if not word.startswith("-") and word.replace("_", "-") not in known:
            raise UsageError(unknown_word(kind, word, known))
    if said := empty_flag(words, ("--only", "--splits")):
        raise UsageError(said)


def run(arguments: Sequence[str] | None = None) -> None:
    """Run one verb; other ends than success by `SystemExit`."""
    words, preset = prepare(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        say(Console(), f"scapo-bench {version('scapo')}")
        sys.exit(0)
    console, errors = Console(), Console(stderr=True)
    logging.basicConfig(
        format="%(message)s", handlers=[RichHandler(console=console, show_path=False)]
    )
    try:
        _check_words(words)
        command: Any = tyro.cli(
            _commands(words[:1], preset),
            prog="scapo-bench",
            description=DESCRIPTION,
            args=words,
            config=(
                tyro.conf.OmitSubcommandPrefixes,
                tyro.conf.CascadeSubcommandArgs,
            ),
        )
        check_numbers(command, "--")
        command.run(console)
    except MemoryError as error:
        say(errors, f"scapo-bench: expected enough memory, found: {error}")
        sys.exit(1)
    except (ValueError, OSError, ArithmeticError, RuntimeError) as error:
        if isinstance(error, BrokenPipeError):
            exit_if_unheard()
        say(errors, f"scapo-bench: {words_of(error)}")
        sys.exit(2 if isinstance(error, UsageError) else 1)
    except KeyboardInterrupt as stop:
        say(errors, f"scapo-bench: {str(stop) or 'interrupted'}")
        exit_interrupted()
