# SPDX-License-Identifier: MIT
"""`scapo-bench` = `python -m bench`: train, predict, score and tabulate.

A verb is a frozen dataclass in `bench.cli` whose fields are the flags, with a method
`run(console)`; `VERBS` lists them. Ends 0 on success, 1 on bad input or a failed job with one
line, 2 on wrong usage, 130 when interrupted.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro
from rich.console import Console
from rich.logging import RichHandler
from rich.markup import escape

from bench.cli.verbs import VERBS
from bench.runs.predict import Predict
from bench.runs.train import prepare, train_verb

DESCRIPTION = "Train, predict, score and tabulate methods of articulated pose estimation."


def _commands(preset: str | None) -> Any:  # noqa: ANN401 - a union made at run time
    verbs = {"train": train_verb(preset), "predict": Predict, **VERBS}
    commands = [Annotated[verb, tyro.conf.subcommand(name)] for name, verb in verbs.items()]
    return Union[tuple(commands)]  # noqa: UP007 - the tuple is not known to the type checker


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb and end the process."""
    words, preset = prepare(sys.argv[1:] if arguments is None else arguments)
    command: Any = tyro.cli(
        _commands(preset),
        prog="scapo-bench",
        description=DESCRIPTION,
        args=words,
        config=(
            tyro.conf.OmitSubcommandPrefixes,
            tyro.conf.CascadeSubcommandArgs,
            tyro.conf.FlagCreatePairsOff,
        ),
    )
    console = Console()
    logging.basicConfig(
        format="%(message)s", handlers=[RichHandler(console=console, show_path=False)]
    )
    try:
        command.run(console)
    except (ValueError, OSError, ArithmeticError, RuntimeError) as error:
        complain(" ".join(str(error).split()))
        sys.exit(1)
    except KeyboardInterrupt as stop:
        complain(str(stop) or "interrupted")
        sys.exit(130)


def complain(line: str) -> None:
    """One line on standard error."""
    Console(stderr=True, soft_wrap=True).print(f"scapo-bench: {escape(line)}", highlight=False)


if __name__ == "__main__":
    main()
