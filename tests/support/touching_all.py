"""All cells of the grid of contact, run with mpirun by test_contact_grid."""

import sys

from support.touching import EVERY, refusal
from support.touching import main as run_cells


def main(target: str) -> None:
    """The end of every cell that runs."""
    run_cells(target, [cell for cell in EVERY if not refusal(cell)])


if __name__ == "__main__":
    main(sys.argv[1])
