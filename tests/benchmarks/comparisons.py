# Licensed under a 3-clause BSD style license - see LICENSE
"""
The same chain at 22 wavelengths x 64 frames with other packages, and written by hand.

A polarizer, a half-wave plate and a derotator on stages, a dichroic and a Wollaston prism: what
a calibration evaluates again and again. Every function takes nothing and returns the fluxes of
the right and the left beam, (22, 64) each.
"""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import system_mueller
from astropolcal.propagation import Propagator

N_WAVELENGTHS, N_FRAMES = 22, 64
POLARIZER, DICHROIC, EFFICIENCY, STRENGTH = 0.1, 0.5, 0.97, 0.03


class Comparison:
    """The numbers that all sides are given, and each side as a method."""

    def __init__(self, n_wavelengths=N_WAVELENGTHS, n_frames=N_FRAMES):
        self.shape = (n_wavelengths, n_frames)
        self.wavelength = np.linspace(1.15, 2.4, n_wavelengths)
        self.hwp, self.derotator = np.linspace(0, np.pi, n_frames), np.linspace(0.7, 2.2, n_frames)
        self.plate = np.linspace(2.8, 3.3, n_wavelengths)
        self.prism = np.linspace(1.0, 3.0, n_wavelengths)
        self.dichroic = np.linspace(0.1, 0.4, n_wavelengths)
        positions = {"hwp": self.hwp, "derotator": self.derotator}
        self._chain = self.chain()
        self._propagator = Propagator(self._chain, self.wavelength, positions)
        self._values = self._propagator.values()

    def chain(self):
        """Our chain."""
        return (
            optics.LinearPolarizer(theta=POLARIZER * u.rad)
            | optics.LinearRetarder(retardance=self.plate * u.rad, mount="hwp")
            | optics.LinearRetarder(retardance=self.prism * u.rad, mount="derotator")
            | optics.DiattenuatorRetarder(diattenuation=STRENGTH, theta=DICHROIC * u.rad,
                                          retardance=self.dichroic * u.rad)
            | optics.WollastonPrism(efficiency=EFFICIENCY)
        )  # fmt: skip

    def ours(self):
        return self._propagator.fluxes(self._values)

    def matrices_by_hand(self):
        """Mueller matrices with numpy, broadcast over wavelengths and frames."""
        light = _turned(_diattenuator_retarder(1.0, 0.0), POLARIZER) @ [1.0, 0.0, 0.0, 0.0]
        for matrix in (
            _turned(_diattenuator_retarder(0.0, self.plate)[:, None], self.hwp),
            _turned(_diattenuator_retarder(0.0, self.prism)[:, None], self.derotator),
            _turned(_diattenuator_retarder(STRENGTH, self.dichroic)[:, None], DICHROIC),
        ):
            light = (matrix @ light[..., None])[..., 0]
        half, split = light[..., 0] / 4, EFFICIENCY * light[..., 1] / 4
        return half + split, half - split

    def components_by_hand(self):
        """Stokes parameters one by one, for these optics in this order and no others."""
        q, u_ = np.cos(2 * POLARIZER) / 2, np.sin(2 * POLARIZER) / 2
        v = 0.0
        for angle, retardance in ((self.hwp, self.plate), (self.derotator, self.prism)):
            cosine, sine = np.cos(2 * angle), np.sin(2 * angle)
            along, across = cosine * q + sine * u_, cosine * u_ - sine * q
            c, s = np.cos(retardance)[:, None], np.sin(retardance)[:, None]
            across, v = c * across + s * v, c * v - s * across
            q, u_ = cosine * along - sine * across, sine * along + cosine * across
        cosine, sine = np.cos(2 * DICHROIC), np.sin(2 * DICHROIC)
        along, across = cosine * q + sine * u_, cosine * u_ - sine * q
        c, s = np.cos(self.dichroic)[:, None], np.sin(self.dichroic)[:, None]
        across = np.sqrt(1 - STRENGTH**2) * (c * across + s * v)
        total, along = 0.5 + STRENGTH * along, STRENGTH * 0.5 + along
        q = cosine * along - sine * across
        return (total + EFFICIENCY * q) / 2, (total - EFFICIENCY * q) / 2

    def katsu(self):
        from katsu import mueller

        def grid(per_frame, per_wavelength):
            return (np.broadcast_to(per_frame, self.shape),
                    np.broadcast_to(per_wavelength[:, None], self.shape))  # fmt: skip

        light = mueller.linear_polarizer(POLARIZER) @ [1.0, 0.0, 0.0, 0.0]
        for per_frame, retardance in ((self.hwp, self.plate), (self.derotator, self.prism)):
            matrix = mueller.linear_retarder(*grid(per_frame, retardance), shape=self.shape)
            light = (matrix @ light[..., None])[..., 0]
        axis = np.full(self.shape[:1], DICHROIC)
        retarder = mueller.linear_retarder(axis, self.dichroic, shape=axis.shape)
        low, high = 1 - STRENGTH, 1 + STRENGTH
        matrix = mueller.linear_diattenuator(DICHROIC, low, Tmax=high) @ retarder
        light = (matrix[:, None] @ light[..., None])[..., 0]
        return [(mueller.wollaston(beam, EFFICIENCY) @ light[..., None])[..., 0, 0]
                for beam in (0, 1)]  # fmt: skip

    def our_system(self):
        """The matrices of the chain for the right beam, (frame, wavelength, 4, 4)."""
        positions = {"hwp": self.hwp * u.rad, "derotator": self.derotator * u.rad}
        return system_mueller(self._chain, self.wavelength * u.um, positions)

    def katsu_system(self, beams=2):
        """The matrices of the chain for one beam or both, (wavelength, frame, 4, 4)."""
        from katsu import mueller

        frames, waves = np.arange(self.shape[1]), np.arange(self.shape[0])[:, None]
        pairs = ((self.hwp, self.plate), (self.derotator, self.prism))
        plate, derotator = (
            mueller.linear_retarder(angle[frames + 0 * waves], retardance[waves + 0 * frames],
                                    shape=self.shape)
            for angle, retardance in pairs
        )  # fmt: skip
        axis = np.full(self.shape[:1], DICHROIC)
        dichroic = mueller.linear_diattenuator(DICHROIC, 1 - STRENGTH, Tmax=1 + STRENGTH)
        dichroic = dichroic @ mueller.linear_retarder(axis, self.dichroic, shape=axis.shape)
        whole = dichroic[:, None] @ derotator @ plate @ mueller.linear_polarizer(POLARIZER)
        return [mueller.wollaston(beam, EFFICIENCY) @ whole for beam in range(beams)]

    def py_pol(self):
        from py_pol.mueller import Mueller
        from py_pol.stokes import Stokes

        frames = [np.tile(a, self.shape[0]) for a in (self.hwp, self.derotator)]
        waves = [np.repeat(a, self.shape[1]) for a in (self.plate, self.prism, self.dichroic)]
        light = Stokes().from_components([1.0, 0.0, 0.0, 0.0])
        low, high = np.sqrt(1 - STRENGTH), np.sqrt(1 + STRENGTH)
        for element in (
            Mueller().diattenuator_perfect(azimuth=POLARIZER),
            Mueller().retarder_linear(ret=waves[0], azimuth=frames[0]),
            Mueller().retarder_linear(ret=waves[1], azimuth=frames[1]),
            Mueller().retarder_linear(ret=waves[2], azimuth=DICHROIC),
            Mueller().diattenuator_linear(p1=high, p2=low, azimuth=DICHROIC),
        ):
            light = element * light
        intensity, q = light.M[0].reshape(self.shape), light.M[1].reshape(self.shape)
        return (intensity + EFFICIENCY * q) / 2, (intensity - EFFICIENCY * q) / 2


def _diattenuator_retarder(strength, retardance):
    retardance = np.asarray(retardance, dtype=float)
    root = np.sqrt(1 - strength**2)
    matrix = np.zeros((*retardance.shape, 4, 4))
    matrix[..., 0, 0] = matrix[..., 1, 1] = 1.0
    matrix[..., 0, 1] = matrix[..., 1, 0] = strength
    matrix[..., 2, 2] = matrix[..., 3, 3] = root * np.cos(retardance)
    matrix[..., 2, 3] = root * np.sin(retardance)
    matrix[..., 3, 2] = -matrix[..., 2, 3]
    return matrix


def _turned(matrix, angle):
    turn = np.zeros((*np.shape(angle), 4, 4))
    turn[..., 0, 0] = turn[..., 3, 3] = 1.0
    turn[..., 1, 1] = turn[..., 2, 2] = np.cos(2 * np.asarray(angle))
    turn[..., 1, 2] = np.sin(2 * np.asarray(angle))
    turn[..., 2, 1] = -turn[..., 1, 2]
    return turn.swapaxes(-1, -2) @ matrix @ turn
