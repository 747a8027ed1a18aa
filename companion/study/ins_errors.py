"""`companion study ins-errors`: natural frequencies of the INS error equations.

The paper's model (Poddubny 1.18, its lost equation restored) and the model complete to first order that
flies, at any latitude and velocity; for a vehicle at rest the laws of the Schuler pair. See
`companion.nav.error_model`.
"""

from __future__ import annotations

import json
import math

import click
import numpy as np

from companion.nav.earth import SPHERE
from companion.nav.error_model import aircraft_model, paper_model
from companion.option_types import FloatRange
from companion.tables import number_table, print_tables

HOUR = 3600.0
MODELS = {"paper (1.18)": paper_model, "complete": aircraft_model}


def eigenvalues(model: str, lat: float, v_north: float, v_east: float) -> list[complex]:
    """Return the seven eigenvalues in 1/h, the fastest first; one of each conjugate pair is left out."""
    A = MODELS[model](lat, v_north, v_east).A
    # velocities and angles differ by six orders of magnitude: balance by the radius
    scale = np.array([1.0 / SPHERE.R] * 2 + [HOUR / SPHERE.R] * 2 + [1.0] * 3)
    found = np.linalg.eigvals(A * scale[:, None] / scale) * HOUR
    upper = [complex(value) for value in found if value.imag > -1e-9]
    return sorted(upper, key=lambda value: -value.imag)


@click.command("ins-errors")
@click.option("--lat-deg", type=FloatRange(-85.0, 85.0), default=60.0, show_default=True, help="Latitude.")
@click.option("--north-mps", type=FloatRange(-1000.0, 1000.0), default=0.0, help="Velocity north [m/s].")
@click.option("--east-mps", type=FloatRange(-1000.0, 1000.0), default=0.0, help="Velocity east [m/s].")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(lat_deg: float, north_mps: float, east_mps: float, as_json: bool) -> None:
    """Print the INS error equations' natural frequencies.

    They are in rad/h.
    """
    lat = math.radians(lat_deg)
    found = {name: eigenvalues(name, lat, north_mps, east_mps) for name in MODELS}
    if as_json:
        click.echo(json.dumps({name: [[v.real, v.imag] for v in values] for name, values in found.items()}))
        return
    title = f"latitude {lat_deg:g} deg, velocity {north_mps:g}, {east_mps:g} m/s; rad/h"
    heads = "model", "Schuler, fast", "Schuler, slow", "Earth's rate", "growth at most, 1/h"
    table = number_table(title, *heads)
    for name, values in found.items():
        growth = max(abs(value.real) for value in values)
        table.add_row(name, *(f"{value.imag:.9f}" for value in values[:3]), f"{growth:.1e}")
    print_tables(table)
    schuler = math.sqrt(SPHERE.G / SPHERE.R)
    click.echo(f"sqrt(G/R) = {schuler * HOUR:.9f} rad/h, period {2.0 * math.pi / schuler / 60.0:.4f} min")
    if north_mps == east_mps == 0.0:
        fast, slow = (value.imag for value in found["paper (1.18)"][:2])
        product = fast * slow / (schuler * HOUR) ** 2
        difference = (fast - slow) / (2.0 * SPHERE.OMEGA * HOUR * math.sin(lat)) if lat else math.nan
        click.echo(f"product of the pair / (G/R) = {product:.9f}")
        click.echo(f"difference of the pair / (2 Omega sin lat) = {difference:.9f}")
