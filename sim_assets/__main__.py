# SPDX-License-Identifier: MIT
"""`scapo-data` = `python -m sim_assets`: assets and the labelled clouds rendered from them.

A verb is a frozen dataclass in `sim_assets.cli.verbs` whose fields are the flags, with a method
`run(console)` that returns the exit code. Ends 0 on success, 1 on bad input or a failed job with
one line, 2 on wrong usage, 130 when interrupted.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro
from rich.console import Console
from rich.markup import escape

from sim_assets.cli.verbs import VERBS

DESCRIPTION = "Make and look at labelled point clouds of articulated objects."


def _commands() -> Any:  # noqa: ANN401 - a union made at run time
    commands = [Annotated[verb, tyro.conf.subcommand(name)] for name, verb in VERBS.items()]
    return Union[tuple(commands)]  # noqa: UP007 - the tuple is not known to the type checker


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb and end the process."""
    command: Any = tyro.cli(
        _commands(),
        prog="scapo-data",
        description=DESCRIPTION,
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    errors = Console(stderr=True, soft_wrap=True, highlight=False)
    try:
        sys.exit(command.run(Console()))
    except (ValueError, OSError, RuntimeError) as error:
        line = " ".join(str(error).split())
        errors.print(f"scapo-data: {escape(line)}")
        sys.exit(1)
    except KeyboardInterrupt:
        errors.print("scapo-data: stopped; the same command takes it up where it was")
        sys.exit(130)


if __name__ == "__main__":
    main()
