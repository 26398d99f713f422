"""Measure a case of fracture, contact or impact at one setting, and write its figures.

python -m fracsim.studies.evidence.precision.fracture_script notched-tension h=3e-05 order=1 step=0.01 -o figures.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from . import FRACTURE_CASES
from .fracture_case import parse_settings


def main() -> None:
    """Measure and write."""
    cases = {case.name: case for case in FRACTURE_CASES}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", choices=cases)
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE")
    parser.add_argument("-o", "--out", type=Path, default=Path("figures.json"))
    given = parser.parse_args()
    figures = cases[given.case].measure(parse_settings(given.settings), given.out.resolve().parent)
    given.out.write_text(json.dumps(figures) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
