# Licensed under a 3-clause BSD style license - see LICENSE
r"""
A small error of any optic: a generator of Mueller matrices times a function of the frame.

Every small change of a Mueller matrix is a sum of a few generators: three of retardance, three of
diattenuation and four of depolarization (Gil & Ossikovski 2016, Polarized Light and the Mueller
Matrix Approach, Chap. 5). A `Perturbation` is :math:`\exp(a\,f\,G)` with a size a, which may
change with the wavelength, a function f of the frame, and one of the generators G.
"""

import re

import numpy as np
from astropy.modeling import Parameter

from astropolcal.exceptions import ParameterError
from astropolcal.mueller import UNITS
from astropolcal.optics.core import _LinearOptic
from astropolcal.optics.modulated import _Modulated
from astropolcal.optics.polarizers import BEAMS, _BeamOptic
from astropolcal.units import to_unit
from astropolcal.words import check_choice

__all__ = ["MuellerElement", "Perturbation"]

_I, _Q, _U, _V = range(4)


#: Generator of each kind of perturbation. Those of retardance and rotation turn the Poincare
#: sphere, those of diattenuation exchange intensity with polarization, and those of depolarization
#: shrink one component against another. ``gain`` acts with opposite signs on the two beams.
GENERATORS = {
    "retardance_h": UNITS[_U, _V] - UNITS[_V, _U],
    "retardance_d": -UNITS[_Q, _V] + UNITS[_V, _Q],
    # of T(angle), twice the angle on the sphere
    "rotation": 2 * UNITS[_Q, _U] - 2 * UNITS[_U, _Q],
    "diattenuation_h": UNITS[_I, _Q] + UNITS[_Q, _I],
    "diattenuation_d": UNITS[_I, _U] + UNITS[_U, _I],
    "diattenuation_c": UNITS[_I, _V] + UNITS[_V, _I],
    "depolarization_linear": -UNITS[_Q, _Q] - UNITS[_U, _U],
    "depolarization_h": -UNITS[_Q, _Q] + UNITS[_U, _U],
    "depolarization_d": -UNITS[_Q, _U] - UNITS[_U, _Q],
    "depolarization_circular": -UNITS[_V, _V],
    "gain": np.eye(4),
}


class Dependence:
    """How a perturbation depends on the frame, by a text.

    ``"constant"``; ``"time"`` and ``"time2"``, a trend through the run and its square;
    ``"step:N"``, from frame N on; ``"frame:N"``, in frame N alone; ``"harmonic:STAGE:N"``, cosine
    and sine of N times the angle of a stage; ``"direction:STAGE"``, where the last move of the
    stage was backwards; ``"move:STAGE"``, how far it was moved, in radian;
    ``"state:COLUMN=STATE"``, in one state of a device or one beam; ``"brightness"``, by what share
    the frame is brighter than the mean; ``"beam"``, with opposite signs for the light of the two
    beams; ``"dataset:NAME"``, in one dataset only. With ``"/dataset:NAME"`` after it, any of the
    others is in that dataset only.
    """

    def __init__(self, text):
        if not isinstance(text, str) or not _FORMS.fullmatch(text):
            raise ParameterError(
                f"dependence = {text!r}; allowed are constant, time, time2, step:FRAME, "
                "frame:FRAME, harmonic:STAGE:N, direction:STAGE, move:STAGE, "
                "state:COLUMN=STATE, brightness, beam and dataset:NAME, each also with "
                "/dataset:NAME after it"
            )
        self.text = text
        #: Name of the one dataset in which it is, None where it is in all.
        self.run = split_run(text)[1]
        #: The words of the text between its colons, without a dataset after it; the first one.
        self.parts = split_run(text)[0].split(":")
        self.kind = self.parts[0]
        #: Number of functions of the frame: two for a harmonic, else one.
        self.count = 2 if self.kind == "harmonic" else 1

    @property
    def driver(self):
        """Name of the position that it follows, None where it is constant."""
        if self.kind in ("constant", "beam", "dataset"):
            return None
        if self.kind in ("harmonic", "state"):
            return self.parts[1]
        if self.kind in ("direction", "move"):
            return f"{self.parts[1]}_{self.kind}"
        if self.kind == "brightness":
            return self.kind
        return "frame" if self.kind in ("step", "frame") else "sequence"

    def waves(self, position):
        """Return the functions at positions of the driver (canonical), shape (count, ...)."""
        x = np.asarray(position, dtype=float)
        if self.kind == "harmonic":
            angle = int(self.parts[2]) * x
            return np.stack([np.cos(angle), np.sin(angle)])
        if self.kind in ("step", "frame"):
            at = int(self.parts[1])
            return np.array([x >= at if self.kind == "step" else x == at], dtype=float)
        one, t = np.ones_like(x), 2 * x - 1
        known = dict.fromkeys(("constant", "beam", "dataset"), one)
        known |= {"time": t, "time2": t**2 - 1 / 3}
        # direction, move, state and brightness are what they follow
        return known.get(self.kind, x)[None]


_FORMS = re.compile(
    r"(constant|time2?|brightness|beam|(step|frame):\d+|harmonic:\w+:[1-9]\d?|(direction|move):\w+"
    r"|state:\w+=[^/:]+)"
    r"(/dataset:.+)?|dataset:.+",
    re.DOTALL,
)
_DATASET = "dataset:"


def split_run(text):
    """
    Return a dependence without its dataset, and the name of that, None where it has none.

    So ``"time/dataset:July"`` is ``("time", "July")``, and ``"dataset:July"`` ``("dataset",
    "July")``.
    """
    if text.startswith(_DATASET):
        return "dataset", text.removeprefix(_DATASET)
    head, _, name = text.partition(f"/{_DATASET}")
    return head, name or None


_ROTATING = ("retardance_h", "retardance_d", "rotation")
# by kind: how often a turn goes round, the generator over that, and the square of this
_POWERS = {kind: (1.0, generator, generator @ generator) for kind, generator in GENERATORS.items()}
_POWERS["rotation"] = (
    2.0,
    GENERATORS["rotation"] / 2,
    GENERATORS["rotation"] @ GENERATORS["rotation"] / 4,
)


class Perturbation(_BeamOptic, _Modulated):
    r"""
    A small error of an optic: :math:`\exp\left[(a f_1 + b f_2)\,G\right]`.

    G is a generator of Mueller matrices and the f are functions of the frame. A gain multiplies the
    flux by :math:`1 \pm (a f_1 + b f_2)`, with the plus for the right beam.

    Parameters
    ----------
    amplitude : float or array_like
        Size a: radian for retardance and rotation, else a share; scalar, or one value per
        wavelength.
    quadrature : float or array_like
        Size b of the second function, the sine of a harmonic; 0 for all other dependences.
    kind : str
        ``"retardance_h"``, ``"retardance_d"``, ``"rotation"``, ``"diattenuation_h"``,
        ``"..._d"``, ``"..._c"``, ``"depolarization_linear"``, ``"..._h"``, ``"..._d"``,
        ``"..._circular"`` or ``"gain"``.
    dependence : str
        ``"constant"``; ``"time"`` and ``"time2"``, a trend through the run and its square;
        ``"step:N"``, from frame N on; ``"frame:N"``; ``"harmonic:STAGE:N"``, cosine and sine of N
        times the angle of a stage; ``"direction:STAGE"`` and ``"move:STAGE"``, the last move of a
        stage; ``"state:COLUMN=STATE"``, in one state or beam; ``"brightness"``, by what share the
        frame is brighter than the mean; ``"beam"``, with the opposite sign for the light that
        becomes the left beam, as other wavelengths in one beam make it; ``"dataset:NAME"``; each
        also with ``"/dataset:NAME"`` after it. The ``mount`` has to be what it follows.
    beam : {"right", "left"}
        The beam that goes on in a chain; of consequence for ``"gain"`` and ``"beam"`` only.
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Raises
    ------
    ParameterError
        If kind or dependence is unknown.

    Examples
    --------
    >>> from astropolcal.optics import Perturbation
    >>> drift = Perturbation(amplitude=0.02, kind="retardance_h", dependence="time", name="drift")
    >>> drift.mount
    'sequence'
    >>> float(drift.mueller(position=1.0)[2, 3].round(5))
    0.02
    """

    # beyond is no small error of anything, and more than a half turn of a retarder
    amplitude = Parameter(default=0.0, bounds=(-4, 4), description="size of the first function")
    quadrature = Parameter(default=0.0, bounds=(-4, 4), description="size of the second function")

    def __init__(self, *args, kind="retardance_h", dependence="constant", **kwargs):
        check_choice("Perturbation.kind", kind, GENERATORS, ParameterError)
        self._kind, self._dependence = kind, Dependence(dependence)
        kwargs.setdefault("mount", self._dependence.driver)
        super().__init__(*args, **kwargs)

    @_BeamOptic.mount.setter
    def mount(self, value):
        """Set the stage, which has to be what the perturbation follows, if anything."""
        driver = self._dependence.driver
        if driver is not None and str(value).removeprefix("-") != driver:
            raise ParameterError(
                f"Perturbation: mount = {value!r}, but {self.dependence!r} follows {driver!r}"
            )
        _BeamOptic.mount.fset(self, value)

    @property
    def kind(self):
        """Key of the generator."""
        return self._kind

    @property
    def dependence(self):
        """How it depends on the frame (str)."""
        return self._dependence.text

    @property
    def depends_on_beam(self):
        """True for a gain and the dependence ``"beam"``: opposite signs in the two beams."""
        return self._kind == "gain" or self._dependence.kind == "beam"

    def _settings(self):
        return super()._settings() | {"kind": self.kind, "dependence": self.dependence}

    def _waves(self, coordinate):
        waves = self._dependence.waves(coordinate)
        waves = waves * BEAMS[self._beam] if self._dependence.kind == "beam" else waves
        return waves if len(waves) == 2 else (waves[0], np.zeros_like(waves[0]))

    def _of(self, x):
        """Return exp(x G); G G G is G, -G (4 times that for rotations), or G is diagonal."""
        x = np.asarray(x)
        if self._kind == "gain":
            return np.multiply.outer(1 + BEAMS[self._beam] * x, np.eye(4))
        rate, unit, square = _POWERS[self._kind]
        if self._kind in _ROTATING:
            odd, even = np.sin(rate * x), 1 - np.cos(rate * x)
        else:
            # for a projector and its negative, sinh and cosh are those of the exponential as well
            odd, even = np.sinh(x), np.cosh(x) - 1
        # in place: half the time of a sum of products
        out = np.multiply.outer(odd, unit)
        out += np.eye(4)
        out += np.multiply.outer(even, square)
        return out

    def _slope(self, x):
        """Return the derivative of the exponential."""
        x = np.asarray(x)[..., None, None]
        if self._kind == "gain":
            return np.broadcast_to(BEAMS[self._beam] * np.eye(4), (*x.shape[:-2], 4, 4))
        rate, unit, square = _POWERS[self._kind]
        if self._kind in _ROTATING:
            return rate * (np.cos(rate * x) * unit + np.sin(rate * x) * square)
        return np.cosh(x) * unit + np.sinh(x) * square


# in the order in which the parameters are declared
_ELEMENTS = [(row, column) for row in range(4) for column in range(4)]


def _element(row, column):
    return Parameter(
        default=float(row == column),
        # fluxes are compared up to a factor: a transmission needs no bound
        bounds=(None, None) if (row, column) == (0, 0) else (-1, 1),
        fixed=True,
        description=f"element in row {row}, column {column}",
    )


class MuellerElement(_LinearOptic):
    """
    General element of constant Mueller matrix; the elements are parameters.

    Parameters
    ----------
    m00, m01, ..., m33 : float or array_like
        The elements, fixed by default; scalars, or one value per wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.optics import MuellerElement
    >>> element = MuellerElement.from_matrix(np.diag([1, 0.9, 0.9, 0.8]), name="window")
    >>> element.m33
    OpticParameter('m33', value=0.8, fixed=True, bounds=(-1, 1))
    """

    _elements = tuple((1.0, (place,)) for place in _ELEMENTS)
    m00, m01, m02, m03 = (_element(0, j) for j in range(4))
    m10, m11, m12, m13 = (_element(1, j) for j in range(4))
    m20, m21, m22, m23 = (_element(2, j) for j in range(4))
    m30, m31, m32, m33 = (_element(3, j) for j in range(4))

    @classmethod
    def from_matrix(cls, matrix, **kwargs):
        """
        Make the element from a Mueller matrix.

        Parameters
        ----------
        matrix : array_like
            Shape (4, 4), or (n_wavelengths, 4, 4).
        **kwargs
            ``name``, ``mount``, ``theta`` as for any optic.

        Returns
        -------
        MuellerElement

        Raises
        ------
        ParameterError
            If the shape is another or an element is not finite.

        Examples
        --------
        >>> import numpy as np
        >>> from astropolcal.optics import MuellerElement
        >>> MuellerElement.from_matrix(np.eye(4)).mueller()[3, 3]
        np.float64(1.0)
        """
        matrix = to_unit(matrix, None, "matrix")
        if matrix.shape[-2:] != (4, 4) or matrix.ndim not in (2, 3):
            raise ParameterError(
                f"a Mueller matrix has shape (4, 4) or (n, 4, 4), not {matrix.shape}"
            )
        return cls(**{f"m{i}{j}": matrix[..., i, j] for i, j in _ELEMENTS}, **kwargs)
