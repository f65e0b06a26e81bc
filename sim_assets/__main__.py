# SPDX-License-Identifier: MIT
"""`scapo-data` = `python -m sim_assets`: assets and the labelled clouds rendered from them.

A verb is a frozen dataclass in `sim_assets.cli.verbs` whose fields are the flags, with a method
`run(console)` that returns the exit code. Ends 0 on success, 1 on bad input or a failed job with
one line, 2 on wrong usage, 130 when interrupted.
"""

# Nothing is imported here: whatever is, an interrupt would find outside of `main`.


def main(arguments: list[str] | tuple[str, ...] | None = None) -> None:
    """Run one verb and end the process."""
    try:
        from scapo.interrupt import quit_at_interrupt

        with quit_at_interrupt("scapo-data"):
            from sim_assets.cli.program import run

        run(arguments)
    except KeyboardInterrupt:
        from scapo.interrupt import exit_interrupted

        exit_interrupted("scapo-data: interrupted")


if __name__ == "__main__":
    main()
