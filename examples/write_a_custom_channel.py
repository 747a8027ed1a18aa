"""Write an inertial channel: constant velocity with white acceleration, corrected by GNSS through a bank."""

import numpy as np

from companion.estimate import bank as banks
from companion.nav.geometry import Geodetic
from companion.navigator.channel import Channel, Nominal, Transition, discretise, moved
from companion.navigator.inertial_track import Point


class ConstantVelocity:
    """Straight on with the first velocity; the grades are accelerations of 0.1, 1, 3 m/s^2 in a second."""

    # states: position error north, east (m), velocity error (m/s), GNSS drift (m), GNSS latency (s)
    n, drift, latency, velocity_noise, wind, grades = 7, slice(4, 6), 6, 0.0, (), (1.0, 0.5, 0.25)

    def prior(self) -> np.ndarray:
        """First covariances (grades, n, n)."""
        return np.tile(np.diag(np.square([50.0, 50.0, 10.0, 10.0, 2.0, 2.0, 0.1])), (3, 1, 1))

    def transition(self, nominal: Nominal) -> Transition:
        """Phi and Q from `nominal.since` to `nominal.point`."""
        A = np.diag([1.0, 1.0, 0.0, 0.0, 0.0], 2) - np.diag([0, 0, 0, 0, 1, 1, 0]) / 60.0
        Q = np.array([np.diag([0.0, 0.0, a * a, a * a, 0.13, 0.13, 1e-8]) for a in (0.1, 1.0, 3.0)])
        return discretise(A, Q, nominal.pending_s)


channel: Channel = ConstantVelocity()
layout = banks.Layout(channel.n, (2,), (banks.Source("gnss", 2, 0),), (), grades=(0, 1, 2))
bank = banks.start(layout, 0.0, np.zeros(channel.n), channel.prior(), channel.grades)
point, rng = Point(0, Geodetic(0.97, 0.65, 500.0), (20.0, 0.0, 0.0)), np.random.default_rng(1)
H = np.hstack((np.eye(2), np.zeros((2, 2)), -np.eye(2), [[20.0], [0.0]]))  # position, drift, latency
for t in range(1, 61):
    since, point = point, moved(point, (20.0, 0.0), t * 10**9)
    bank = banks.propagate(bank, layout, 1.0, *channel.transition(Nominal(point, (0.0, 0.0), since)))
    true = np.array([-0.25, 0.1]) * t**2  # the aircraft accelerates, the channel does not
    bank, _ = banks.update(bank, layout, true + rng.normal(0.0, 0.7, 2), H, 0.5 * np.eye(2), 0)
x, P = banks.estimate(bank, layout)
print(f"true error {true} m, estimate {x[:2].round(1)} m, sigma {P[0, 0] ** 0.5:.1f} m")
