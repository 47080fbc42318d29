"""Tables of tensors with one row a window, joined and picked from as one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Rows:
    """A record whose fields are tensors, or such records, of as many rows."""

    def __len__(self) -> int:
        return len(next(_list_columns(self)))


Table = TypeVar("Table", bound=Rows)


def take_rows(table: Table, rows: Tensor) -> Table:
    """Return some rows of a table: by their numbers, or where a mask is true."""
    return type(table)(
        *(take_rows(column, rows) if isinstance(column, Rows) else column[rows] for column in _list_columns(table))
    )


def join_rows(tables: Sequence[Table]) -> Table:
    """Return the rows of several tables, at least one, one after the other."""
    columns = zip(*map(_list_columns, tables), strict=True)
    return type(tables[0])(
        *(join_rows(column) if isinstance(column[0], Rows) else torch.cat(list(column)) for column in columns)
    )


def average_tables(tables: Sequence[Table]) -> Table:
    """Return the mean of several tables of tensors, at least one, of as many rows each."""
    columns = zip(*map(_list_columns, tables), strict=True)
    return type(tables[0])(*(torch.stack(column).mean(dim=0) for column in columns))


def _list_columns(table: Rows) -> Iterator[Any]:
    return (getattr(table, each.name) for each in fields(table))
