"""`python -m segslam`."""

from segslam.cli import main

main()
