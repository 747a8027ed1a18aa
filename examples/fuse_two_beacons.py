"""Fuse azimuth and range of two beacons by maximum likelihood: position and covariance.

The frame is local: x east, y north, z up, metres.
"""

import math

import numpy as np

from companion.estimate.fusion import Azimuth, Height, Range, maximum_likelihood

sigma_azimuth = math.radians(0.125)
beacons = {"east": (60_000.0, 5_000.0, 200.0), "north": (-10_000.0, 80_000.0, 150.0)}
aircraft = np.array([1_000.0, 2_000.0, 1_500.0])
rng = np.random.default_rng(1)
observations = [Height(1_500.0, 20.0)]
for beacon in beacons.values():
    east, north, up = aircraft - beacon
    azimuth = math.atan2(east, north) + sigma_azimuth * rng.standard_normal()
    slant = math.sqrt(east**2 + north**2 + up**2) + 100.0 * rng.standard_normal()
    observations += [Azimuth(beacon, azimuth, sigma_azimuth), Range(beacon, slant, 100.0)]

fix = maximum_likelihood(observations)
error = np.asarray(fix.position) - aircraft
sigma = np.sqrt(np.diag(fix.covariance))
print(f"position  {np.round(fix.position, 1)} m, {fix.iterations} iterations")
print(f"sigma     {np.round(sigma, 1)} m")
print(f"error     {np.round(error, 1)} m")
print(f"residuals chi-square {fix.cost:.1f} with {fix.degrees_of_freedom} degrees of freedom")
assert np.all(np.abs(error) < 5.0 * sigma)
