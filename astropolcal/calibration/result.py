# Licensed under a 3-clause BSD style license - see LICENSE
"""The result of a calibration: chains, errors, accuracy, posterior, provenance."""

from copy import deepcopy
from dataclasses import dataclass, field, replace

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration.accuracy import accuracy_table, cross_validated_residuals
from astropolcal.calibration.bounds import status_of
from astropolcal.calibration.groups import groups_by
from astropolcal.chain import leaves
from astropolcal.exceptions import CalibrationFileError

__all__ = ["Calibration", "DatasetRecord"]

# what is known of each element of a parameter, and what is said of those without an error
_OF_ELEMENTS = (
    "std",
    "identifiable",
    "at_bound",
    "std_inward",
    "conditional_on",
    "std_released",
)
_UNKNOWN = (np.nan, False, False, np.nan, "", np.nan)


@dataclass
class DatasetRecord:
    """
    What a calibration remembers of one dataset.

    Parameters
    ----------
    name : str
        Name of the dataset.
    source : str or None
        What sent the light.
    content_hash : str
        SHA-256 of the table's content.
    meta : dict
        The table's meta: instrument, date, optics in the beam.
    n_frames, n_masked : int
        Frames, and cells of frame and wavelength that were masked.
    accuracy : `~astropy.table.QTable`
        Accuracy per wavelength, see `accuracy_table`.

    Examples
    --------
    >>> from astropolcal.calibration import DatasetRecord
    >>> DatasetRecord("night1", "polarized", "00", {}, 64, 0).name
    'night1'
    """

    name: str
    source: str | None
    content_hash: str
    meta: dict
    n_frames: int
    n_masked: int
    accuracy: QTable | None = None


@dataclass
class Calibration:
    """
    A calibrated instrument; `calibrate` makes it, ASDF files keep it.

    Parameters
    ----------
    chains : list of `~astropy.modeling.CompoundModel`
        The calibrated chain of each dataset, sharing their optics' values.
    wavelength : `~astropy.units.Quantity`
        Grid of the parameters given per wavelength.
    covariance : Covariance
        Of the free parameters, with names and units.
    identifiability : Identifiability
        Rank and null directions.
    at_bound : list of str
        Free parameters that ended at a bound.
    datasets : list of DatasetRecord
        The data behind it.
    settings : dict
        ``instrument``, ``observable``, ``fitter``, ``strategy``, ``weights``.
    fit : dict
        ``seconds``, ``n_data``, ``converged``, ``message``, ``evaluations``.
    ties : dict of str to Tie
        Parameters that follow others.
    stages : list of dict
        Parameter values after each step of the two-step strategy.
    measurement : Measurement or None
        The fitted model; None after reading from a file.
    provenance : dict
        Software versions and time of the fit.
    posterior : Posterior or None
        Samples of the parameters' posterior, where `sample` made some. A file
        keeps some of them, see `~astropolcal.calibration.Posterior.thinned`.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> cal.chain["hwp"].w_sio2.unit, len(cal.accuracy)
    (Unit("mm"), 22)
    """

    chains: list
    wavelength: u.Quantity
    covariance: object
    identifiability: object
    at_bound: list
    datasets: list
    settings: dict
    fit: dict
    ties: dict = field(default_factory=dict)
    stages: list = field(default_factory=list)
    measurement: object = None
    provenance: dict = field(default_factory=dict)
    posterior: object = None

    @property
    def chain(self):
        """The calibrated chain of the first dataset."""
        return self.chains[0]

    @property
    def instrument(self):
        """Name of the instrument, or None."""
        return self.settings.get("instrument")

    @property
    def converged(self):
        """Whether the fitter says that it has arrived."""
        return bool(self.fit.get("converged"))

    @property
    def residuals(self):
        """
        Residuals of all data, observed minus model, shape (n_data,).

        Raises
        ------
        CalibrationFileError
            If the calibration was read from a file, which holds no data.
        """
        return self.live_measurement().residuals()

    def live_measurement(self):
        """
        Return the fitted measurement, for what needs the data.

        Returns
        -------
        Measurement

        Raises
        ------
        CalibrationFileError
            If the calibration was read from a file, which holds no data.
        """
        if self.measurement is None:
            raise CalibrationFileError(
                "this calibration was read from a file, which holds no observations; "
                "with_observations(observations) brings back those it was made from, "
                "measurement_of(observations) predicts others"
            )
        return self.measurement

    def with_observations(self, observations, positions=None):
        """
        Return the calibration together with the data that it was made from.

        Parameters
        ----------
        observations : Observations or sequence of Observations
            All of its datasets, in any order. They are recognized by their
            content, not by their names.
        positions : dict or sequence of dict, optional
            Position of every stage for each of them, see
            `~astropolcal.measurement.Measurement`; by default as the
            calibration's instrument reads it, or the columns of the tables.

        Returns
        -------
        Calibration
            With ``measurement``, so that residuals, cross-validation and
            sampling work as before it was written.

        Raises
        ------
        CalibrationFileError
            If a table is missing or is none of the calibration's, or if the
            residuals are not those of the fit.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal import Calibration, calibrate, instruments
        >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
        >>> charis = instruments.get("charis")
        >>> chain = charis.chain(derotator="linear")
        >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
        >>> data = simulate(chain, charis.wavelength, frames, seed=2)
        >>> calibrate(chain, data, instrument="charis").write("with_data.asdf")
        >>> cal = Calibration.read("with_data.asdf").with_observations(data)
        >>> cal.residuals.size
        264
        """
        from astropolcal.calibration._reunite import measurement_of_all

        measurement = measurement_of_all(self, observations, positions)
        # so that a cross-validation of the new one does not change the old one's accuracies
        records = deepcopy(self.datasets)
        return replace(self, chains=measurement.chains, measurement=measurement, datasets=records)

    def measurement_of(self, observations, dataset=0, positions=None):
        """
        Return a measurement of new observations with the calibrated chain.

        Parameters
        ----------
        observations : Observations
            New frames of the same set-up.
        dataset : int
            Which of the calibration's chains is meant.
        positions : dict, optional
            Position of every stage, see `~astropolcal.measurement.Measurement`.

        Returns
        -------
        Measurement
            Not fitted: its residuals tell how well the calibration predicts.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal import calibrate, instruments
        >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
        >>> charis = instruments.get("charis")
        >>> chain = charis.chain(derotator="linear")
        >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
        >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
        >>> new = simulate(chain, charis.wavelength, frames, seed=3)
        >>> bool(abs(cal.measurement_of(new).residuals()).max() < 0.01)
        True
        """
        from astropolcal.measurement import Measurement

        return Measurement(
            self.chains[dataset],
            observations,
            observable=self.settings["observable"],
            positions=None if positions is None else [positions],
            ties=self.ties,
            wavelength=self.wavelength,
        )

    def cross_validate(self, groups=None):
        """
        Fill ``s_cv``: refit without each derotator angle and predict it.

        Parameters
        ----------
        groups : `~numpy.ndarray` or str, optional
            Group of each datum, or what makes a group, see `groups_by`; by
            default its derotator angle.

        Returns
        -------
        Calibration
            Itself.
        """
        live = self.live_measurement()
        # what was left out before is no longer true, should the refits fail
        self.fit.pop("groups", None)
        if groups is not None:
            self.fit["groups"] = groups if isinstance(groups, str) else "given"
        if isinstance(groups, str):
            groups = groups_by(live, groups)
        held_out = cross_validated_residuals(live, live.vector(), self._weights(), groups)
        residuals = live.residuals()
        for i, record in enumerate(self.datasets):
            before, record.accuracy = record.accuracy, accuracy_table(live, i, residuals, held_out)
            # predictions of standards stay: they do not depend on what was left out
            if before is not None and "s_standard" in before.colnames:
                record.accuracy["s_standard"] = before["s_standard"]
        return self

    def _weights(self):
        """Return one over the noise of each datum, None where all weigh the same."""
        from astropolcal.calibration.weighting import weighting_of

        return None if self.settings.get("weights") is None else weighting_of(self).weight

    @property
    def accuracy(self):
        """Accuracy per wavelength of the first dataset, a `~astropy.table.QTable`."""
        return self.datasets[0].accuracy

    # ---- parameters ----------------------------------------------------------

    def parameter_values(self):
        """
        Return every parameter of every optic with all that is known of it.

        Returns
        -------
        dict of str to dict
            ``"optic.parameter"`` to ``value``, ``std`` (NaN where not
            determined), ``unit``, ``bounds``, ``fixed``, ``tied``, ``at_bound``,
            ``identifiable``; ``status`` (``"determined"``, ``"by priors"``,
            ``"conditional"``, ``"badly determined"``, ``"open"``,
            ``"at bound"``, ``"tied"`` or ``"fixed"``); ``std_inward``, how far
            what is at a bound may go inward at one sigma; and for errors that
            hang on such a bound ``conditional_on``, the names of what is at
            it, and ``std_released``, the error without it. Arrays for
            parameters given per wavelength.
        """
        result = {}
        for chain in self.chains:
            for leaf in leaves(chain):
                for key in leaf.param_names:
                    name = f"{leaf.name}.{key}"
                    # chains share optics by name, and the values of the fit
                    if name not in result:
                        result[name] = self._describe(name, getattr(leaf, key))
        return result

    def _describe(self, name, parameter):
        size = int(np.size(parameter.value))
        # the covariance has rows of free parameters only
        free = not parameter.fixed and name not in self.ties
        elements = [name] if size == 1 else [f"{name}[{i}]" for i in range(size)]
        shape = np.shape(parameter.value)
        known = self._known() if free else {}
        rows = [known.get(element, _UNKNOWN) for element in elements]
        columns = (np.array(column).reshape(shape) for column in zip(*rows, strict=True))
        entry = {
            "value": np.array(parameter.value),
            "unit": parameter.unit,
            "bounds": tuple(parameter.bounds),
            "fixed": bool(parameter.fixed),
            "tied": self.ties[name].source if name in self.ties else None,
            **dict(zip(_OF_ELEMENTS, columns, strict=True)),
        }
        return entry | {"status": status_of(entry)}

    def _known(self):
        stds, flags = self.covariance.stds, self.identifiability.identifiable
        bound, found = set(self.at_bound), self.fit.get("bounds") or {}
        inward, released = found.get("inward", {}), found.get("released", {})
        known = {}
        for i, name in enumerate(self.covariance.names):
            more = released.get(name, {"without": np.nan, "slack": 0.0, "by": []})
            # the error with all bounds as exact, as independent data have it, and with none
            slack = 0.0 if self.settings.get("errors") == "white" else more["slack"]
            exact = np.sqrt(max(stds[i] ** 2 - slack**2, 0.0))
            beyond = np.hypot(exact, more["without"])
            beside = (inward.get(name, np.nan), ", ".join(more["by"]), beyond)
            known[name] = (stds[i], bool(flags[i]), name in bound, *beside)
        return known

    @property
    def parameters(self):
        """
        One row a free parameter: name, value, unit, errors, status; a `~astropy.table.QTable`.

        The columns are those of `parameter_values`.
        """
        keys, rows = ("value", *_OF_ELEMENTS, "status"), []
        for name, known in self.parameter_values().items():
            if known["fixed"] or known["tied"]:
                continue
            size, unit = np.size(known["value"]), str(known["unit"] or "")
            labels = [name] if size == 1 else [f"{name}[{i}]" for i in range(size)]
            flat = (np.ravel(known[key]) for key in keys)
            rows += [(label, *row, unit) for label, *row in zip(labels, *flat, strict=True)]
        types = (str, float, float, bool, bool, float, str, float, str, str)
        table = QTable(
            rows=rows or None, names=("name", *keys, "unit"), dtype=None if rows else types
        )
        return table["name", "value", "std", "unit", "status", *_OF_ELEMENTS[1:]]

    # ---- for pipelines ---------------------------------------------------------

    @property
    def validity(self):
        """For what it holds, a `~astropolcal.calibration.Validity`."""
        from astropolcal.calibration.validity import validity_of

        return validity_of(self)

    def system_mueller(self, header=None, **options):
        """
        Return the system Mueller matrix of frames, with its covariance.

        Parameters
        ----------
        header : `~astropy.io.fits.Header`, mapping, or sequence of those
            Primary header of a frame, or those of several.
        **options
            See `~astropolcal.calibration.LoadedCalibration.system_mueller`.

        Returns
        -------
        SystemMueller
        """
        from astropolcal.calibration.loading import load

        return load(self).system_mueller(header, **options)

    # ---- in words and files ----------------------------------------------------

    def verdict(self):
        """
        Return whether it can be used, and why not.

        Returns
        -------
        `~astropolcal.calibration.Verdict`
        """
        from astropolcal.calibration.verdicts import verdict

        return verdict(self)

    def summary(self, full=False):
        """
        Return a text for the terminal: whether it is usable, how good, what came out.

        Parameters
        ----------
        full : bool
            Whether to add the tables per wavelength, what is not determined in
            detail, and the gauge.

        Returns
        -------
        str
        """
        from astropolcal.calibration.summaries import summary

        return summary(self, full=full)

    def to_dict(self):
        """
        Return the summary for machines, ready for JSON.

        Returns
        -------
        dict
            The keys of ``astropolcal calibrate --json``; not-a-number as None.
        """
        from astropolcal.calibration.summaries import to_dict

        return to_dict(self)

    def write(self, path, overwrite=False):
        """
        Write the calibration to an ASDF file, atomically.

        Parameters
        ----------
        path : path-like
            The file.
        overwrite : bool
            Whether an existing file may be replaced.

        Raises
        ------
        CalibrationFileError
            If the file exists or cannot be written.
        """
        from astropolcal.calibration.files import write_calibration

        write_calibration(self, path, overwrite=overwrite)

    @classmethod
    def read(cls, path):
        """
        Read a calibration from an ASDF file, validated.

        Parameters
        ----------
        path : path-like
            The file.

        Returns
        -------
        Calibration

        Raises
        ------
        CalibrationFileError
            If the file is missing, damaged, of another version, or not ours.
        """
        from astropolcal.calibration.files import read_calibration

        return read_calibration(path)

    def __repr__(self):
        names = ", ".join(record.name for record in self.datasets)
        sampled = "" if self.posterior is None else f", {len(self.posterior.names)} sampled"
        return (
            f"<Calibration of {self.instrument or 'an instrument'} from {names}: "
            f"{len(self.covariance)} free parameters, rank {self.identifiability.rank}{sampled}>"
        )
