"""Keeps figures: one row per measurement in `results.csv`, with the commit and the machine."""

from __future__ import annotations

import csv
import datetime
import os
import platform
import subprocess
from pathlib import Path

PATH = Path(__file__).with_name("results.csv")
COLUMNS = ("date", "commit", "machine", "benchmark", "scene", "figure", "value")


def add_row(benchmark: str, scene: str, figures: dict[str, float]) -> None:
    """Print figures and append them to the file.

    Parameters
    ----------
    benchmark : str
        What was measured.
    scene : str
        On what.
    figures : dict
        Values by name; the name holds the unit.
    """
    fresh = not PATH.exists()
    common = (datetime.date.today().isoformat(), commit(), machine(), benchmark, scene)
    with PATH.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if fresh:
            writer.writerow(COLUMNS)
        for name, value in figures.items():
            writer.writerow((*common, name, f"{value:.6g}"))
            print(f"{benchmark} {scene}: {name} = {value:.6g}")


def commit() -> str:
    """The checked-out commit, with a plus where files differ from it."""
    here = Path(__file__).parent
    run = ["git", "-C", str(here), "describe", "--always", "--dirty=+", "--exclude=*"]
    return subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip()


def machine() -> str:
    """Cores and processor."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        name = models[0] if models else name
    return f"{os.cpu_count()} x {name}"
