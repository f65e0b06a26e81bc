# SPDX-License-Identifier: MIT
"""`scapo-bench` = `python -m bench`: train, predict, score and tabulate.

A verb is a frozen dataclass in `bench.cli.verbs` whose fields are the flags, with a method
`run(console)`. Ends 0 on success, 1 on bad input or a failed job with one line, 2 on wrong usage,
130 when interrupted.
"""

# Nothing is imported here: whatever is, an interrupt would find outside of `main`.


def main(arguments: list[str] | tuple[str, ...] | None = None) -> None:
    """Run one verb and end the process."""
    try:
        from scapo.interrupt import quit_at_interrupt

        with quit_at_interrupt("scapo-bench"):
            from bench.cli.program import run

        run(arguments)
    except KeyboardInterrupt:
        from scapo.interrupt import exit_interrupted

        exit_interrupted("scapo-bench: interrupted")


if __name__ == "__main__":
    main()
