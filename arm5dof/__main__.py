"""`python -m arm5dof`, and the command `arm5dof`."""

from arm5dof.cli import interrupts


def main() -> None:
    """Run the command line and end the process."""
    interrupts.listen()
    try:
        from arm5dof.cli.main import main as run

        status = run()
    except Exception:
        if interrupts.heard():
            interrupts.end()
        raise
    interrupts.leave(status)


if __name__ == "__main__":
    main()
