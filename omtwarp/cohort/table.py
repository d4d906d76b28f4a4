"""One table of a cohort: Parquet where pyarrow is installed, else CSV."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from omtwarp.cohort.item import NUMBERS, OF_REGISTRATION, OK, REAL, WHOLE, Row
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import staged

TABLES = "table.parquet", "table.csv"
ORDER = ("id", "path", "status", *WHOLE[:3], *NUMBERS, "memory", "version", "message", "map_size", "map_digest", "key")
GROUP, REGISTERED_MAPS = "group", "registered"  # what maps are registered to, and the folder where they go then
REGISTERED = ("registered_to", *OF_REGISTRATION)  # columns where maps are registered


def columns_of(rows: Sequence[Row]) -> list[str]:
    """Return the names of a table's columns: the manifest's own after ``path``, then the others in a fixed order."""
    given = dict.fromkeys(name for row in rows for name in row)
    own = [name for name in given if name not in ORDER and name not in REGISTERED]
    return [*ORDER[:2], *own, *ORDER[2:], *(name for name in REGISTERED if name in given)]


def write_table(rows: Sequence[Row], folder: Path) -> Path:
    """Write ``table.parquet``, or ``table.csv`` where there is no pyarrow; whichever is older is removed.

    Args:
        rows: one per item; missing values are left out.
        folder: where the table goes.
    """
    names = columns_of(rows)
    try:
        import pyarrow as arrow
        import pyarrow.parquet as parquet
    except ImportError:
        target = folder / "table.csv"
        with staged(target) as file, open(file, "w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(names)
            writer.writerows([["" if row.get(name) is None else row[name] for name in names] for row in rows])
    else:
        target = folder / "table.parquet"
        kinds = {name: arrow.int64() for name in WHOLE} | {name: arrow.float64() for name in REAL}
        columns = [arrow.array([row.get(name) for row in rows], kinds.get(name, arrow.string())) for name in names]
        with staged(target) as file:
            parquet.write_table(arrow.table(columns, names=names), file)
    other = folder / ("table.csv" if target.suffix == ".parquet" else "table.parquet")
    other.unlink(missing_ok=True)
    return target


def read_table(path: Path) -> list[Row]:
    """Read a table that :func:`write_table` wrote; a CSV's numbers become numbers, its empty fields None."""
    if path.suffix == ".parquet":
        import pyarrow.parquet as parquet

        rows: list[Row] = parquet.read_table(path).to_pylist()
        return rows
    with open(path, encoding="utf-8", newline="") as stream:
        return [
            {
                name: (int(value) if name in WHOLE else float(value) if name in REAL else value) if value else None
                for name, value in row.items()
            }
            for row in csv.DictReader(stream)
        ]


def map_of(folder: Path, row: Row) -> Path:
    """Return the file of an item's map in a cohort's folder, registered where the table says so."""
    return folder / (REGISTERED_MAPS if row.get("registered_to") == GROUP else "maps") / f"{row['id']}.npz"


def table_of_cohort(source: Path) -> tuple[Path, list[Row]] | None:
    """Return the folder of a cohort and its mapped rows, or None where the source is neither folder nor table of one.

    Args:
        source: the folder of a cohort's results, or the table in it.

    Raises:
        OmtwarpError: the table cannot be read, or has columns that no cohort writes.
    """
    folder = source if source.is_dir() else source.parent
    tables = [folder / name for name in TABLES if (folder / name).is_file()]
    if not (folder / "maps").is_dir() or not tables or source not in (folder, *tables):
        return None
    table = source if source in tables else tables[0]
    try:
        rows = read_table(table)
        return folder, [row for row in rows if row["status"] == OK]
    except ImportError as error:
        raise OmtwarpError(f"'{table}' needs the package pyarrow: pip install 'omtwarp[tables]'") from error
    except (OSError, ValueError, KeyError) as error:
        raise OmtwarpError(f"'{table}' cannot be read as a cohort's table: {error}") from None
