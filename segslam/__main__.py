"""`python -m segslam`, and the command `segslam`."""


def main() -> None:
    """Handle Ctrl-C before anything else is imported, then run the command."""
    from segslam.core.interrupts import ctrl_c_in_order

    with ctrl_c_in_order():
        from segslam import cli

        cli.main()


if __name__ == "__main__":
    main()
