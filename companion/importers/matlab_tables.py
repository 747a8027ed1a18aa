"""`python matlab_tables.py FILE BYTES NAME...`: tables of a MATLAB file with labels, as .npz on stdout.

A process of its own with limited memory and processor time, that knows nothing of this package: scipy's
reader is made for trusted files: a damaged data type ends the process in C (scipy pull request 25349).
"""

from __future__ import annotations

import io
import resource
import sys

import numpy as np
from scipy.io import loadmat

MAX_MEMORY = 1 << 30
MAX_CPU_S = 10


def main(path: str, limit: int, names: list[str]) -> None:
    """Write each table of floats (n, columns) as NAME and its column names (columns,) as NAME_label.

    Raises ValueError if they have more than `limit` bytes.
    """
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY, MAX_MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_S, MAX_CPU_S))
    tables = loadmat(path, variable_names=[label for name in names for label in (name, f"{name}_label")])
    found = {}
    for name in names:
        if name in tables and f"{name}_label" in tables and tables[name].dtype.kind == "f":
            cells = [cell[0] for cell in tables[f"{name}_label"]]
            found[name] = tables[name]
            found[f"{name}_label"] = np.array([str(cell[0]) if cell.size else "" for cell in cells])
    if (size := sum(table.nbytes for table in found.values())) > limit:
        raise ValueError(f"its tables have {size} bytes (limit {limit})")
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, **found)
    sys.stdout.buffer.write(out.getvalue())


if __name__ == "__main__":
    try:
        main(sys.argv[1], int(sys.argv[2]), sys.argv[3:])
    except Exception as error:  # scipy raises many different exceptions
        sys.exit(str(error) or type(error).__name__)
