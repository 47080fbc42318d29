"""What gives motion away, as JSON and as tables: of `mapctl measure --why` and `mapctl bench why`."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from mapctl.commands.shared.tables import print_table
from mapctl.metrics.realism import Explanation

TABLES = ("joints", "bands", "cells", "inputs", "phases", "feet")
"""Tables of shares of the evidence, as `Explanation` and JSON name them."""
_TITLES = {
    "joints": "joint, from the one above it",
    "bands": "band",
    "cells": "joint and band",
    "inputs": "kind of input",
    "phases": "moment of the step",
    "feet": "lower leg, foot and toes, by their foot",
}
_MOST = 8  # rows of a table


def summarise_explanation(explanation: Explanation, clips: Sequence[str]) -> dict[str, Any]:
    """Summarise an explanation as JSON holds it: shares of the evidence say whether they are more than chance, moments
    name their clip. `clips` are the names of the made clips."""
    values = asdict(explanation)
    for table in TABLES:
        values[table] = [
            asdict(share) | {"named": explanation.told_apart and share.named} for share in getattr(explanation, table)
        ]
    values["moments"] = [asdict(moment) | {"clip": clips[moment.clip]} for moment in explanation.moments]
    return values


def describe_verdict(why: Mapping[str, Any]) -> str:
    """Describe how often sets are told apart, and whether that is more than chance."""
    low, high = 100 * why["accuracy_low"], 100 * why["accuracy_high"]
    about = (
        f"after {why['steps']} steps told apart in {100 * why['accuracy']:.0f} % ({low:.0f} to {high:.0f}),"
        f" halves of the reference in {100 * why['floor']:.0f} %"
    )
    return about if why["told_apart"] else f"{about}: not above the floor, so no cause is named"


def print_explanation(why: Mapping[str, Any]) -> None:
    """Print a summary: tables of what is more than chance, gaits, and moments."""
    print(f"why: {describe_verdict(why)}")
    for table in TABLES:
        named = [row for row in why[table] if row["named"]]
        if named:
            _print_shares(_TITLES[table], named[:_MOST])
    if why["regions"]:
        regions = [[name, 100 * accuracy] for name, accuracy in why["regions"].items()]
        print_table(["region alone", "told apart, %"], regions)
    rows = [
        [
            row["gait"],
            row["made_windows"],
            row["mocap_windows"],
            *(100 * row[name] for name in ("accuracy", "floor")),
            *((row[name] if why["told_apart"] else None) for name in ("joint", "band")),
        ]
        for row in why["gaits"]
    ]
    columns = ["gait", "windows", "of the reference", "told apart, %", "floor, %", "most by", "in the band"]
    print_table(columns, rows, title="by gait of the second")
    if why["told_apart"]:
        for moment in why["moments"]:
            print(describe_moment(moment))


def describe_moment(moment: Mapping[str, Any]) -> str:
    """Describe a moment so that it can be looked at."""
    return (
        f"look at {moment['clip']} at {moment['seconds']:.1f} s: {moment['joint']}, {moment['band']}"
        f" ({moment['phase']}; {moment['gait']})"
    )


def _print_shares(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print shares in per cent; columns of what was not measured are left out."""
    columns = [title, "share of evidence, %", "from", "to"]
    percent = ["share", "low", "high"]
    more = {"exchanged": "told apart when exchanged, %", "alone": "alone, %", "frames": "of the frames, %"}
    for name, column in more.items():
        if rows[0][name] is not None:
            columns.append(column)
            percent.append(name)
    print_table(columns, [[row["name"], *(100 * row[name] for name in percent)] for row in rows])
