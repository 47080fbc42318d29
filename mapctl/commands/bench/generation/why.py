"""`mapctl bench why`: what gives generated motion away beside mocap."""

import re

import priors
from controllers.benchmarks.generation import Variant, list_variants
from controllers.benchmarks.generation.why import WhyBenchmarkSettings, benchmark_why
from controllers.benchmarks.shared.held_out import load_named
from mapctl.commands.bench import Why
from mapctl.commands.bench.baselines import load_generators
from mapctl.commands.bench.output import print_parts
from mapctl.errors import RequestError


def run(table: Why) -> int:
    """Measure and print."""
    settings = WhyBenchmarkSettings(table.starts == "unseen", table.count, table.seconds, _read_steps(table.steps))
    prior, held_out, densities, refiners = load_generators(table.prior, table.baselines)
    refiner = priors.refiner_of(table.prior, table.refiner)
    variants = _pick_variants(list_variants(prior, refiner, densities, refiners), table.variants)
    parts = benchmark_why(variants, load_named(table.data, held_out), settings)
    return print_parts(table, {name: rows for name, rows in parts.items() if rows}, markdown=table.markdown)


def _read_steps(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise RequestError(f"--steps are whole numbers with commas between, got {text!r}") from None


def _pick_variants(variants: list[Variant], pattern: str) -> list[Variant]:
    """Pick the variants whose names fit; RequestError where none does."""
    try:
        picked = [each for each in variants if re.fullmatch(pattern, each.name)]
    except re.error as error:
        raise RequestError(f"--variants is no regular expression: {error}") from error
    if not picked:
        raise RequestError(f"no variant is called {pattern!r}; there are {'; '.join(each.name for each in variants)}")
    return picked
