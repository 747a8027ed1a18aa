"""Entry point of the command line, which is imported once Ctrl-C ends the process quietly."""

import os


def main() -> None:
    """Run the command line."""
    try:
        from companion import interrupt

        interrupt.end_at_interrupt()
    except KeyboardInterrupt:  # as `interrupt.end`, which may not be imported yet
        os.write(2, b"companion: interrupted\n")
        os._exit(130)
    from companion import command_line

    command_line.main()


if __name__ == "__main__":
    main()
