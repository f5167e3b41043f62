# Licensed under a 3-clause BSD style license - see LICENSE
"""
What an instrument is to astropolcal: its chain, its stages, its tables.

With how its stages follow the sky, and the nuisance of a dataset: background in the apertures,
unequal gains of the beams and the polarization of a lamp that is called unpolarized are optics
of one dataset, with its name, and with a prior that keeps them small where the data cannot tell
them from what the datasets share.

What most instruments share is a chain of source or star, telescope, and what is downstream of them.
One at a telescope of its own gives `Polarimeter.inner`, the optics from its entrance on; what
shares Subaru's telescope, half-wave plate and derotator is a `SubaruPolarimeter` and gives its
`SubaruPolarimeter.camera`.
"""

import inspect
import math
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import join, leaves, parted, stages
from astropolcal.exceptions import ChainError, InstrumentError
from astropolcal.instruments import telescope as shared
from astropolcal.instruments.layout import COMMON, FileLayout
from astropolcal.observations import grid as tables
from astropolcal.observations import pointings
from astropolcal.observations.reading import common_wavelengths
from astropolcal.optics._modelling import FrozenNormal
from astropolcal.units import wavelengths_of
from astropolcal.words import check_choice

__all__ = ["Instrument", "SkyLaw", "add_nuisance"]


@dataclass(frozen=True)
class SkyLaw:
    r"""
    How half-wave plate and derotator follow parallactic angle *p* and altitude *a*.

    .. math:: \theta = \theta_0 + f\,p + g\,a

    with the commanded angle, or an offset, :math:`\theta_0`.

    Parameters
    ----------
    plate : (float, float) or dict of str to (float, float)
        (f, g) of the half-wave plate; (0, 0) for one that stays where it is put. Where it depends
        on what the derotator stabilizes, one for each mode, such as ``"field"`` and ``"pupil"``.
        Without it that of Subaru, (0.5, 1).
    derotator : dict of str to (float, float)
        (f, g) of the derotator for each mode; empty where there is none. Without it that of a
        Nasmyth focus: (0, 0.5) for ``"pupil"``, (0.5, 0.5) for ``"field"``.

    Raises
    ------
    InstrumentError
        If a law is not two finite numbers, or plate and derotator have other modes.

    Examples
    --------
    A polarimeter at a Cassegrain focus, which turns with the telescope:

    >>> from astropolcal.instruments import SkyLaw
    >>> SkyLaw(plate=(0, 0), derotator={}).plate_law()
    (0.0, 0.0)

    One whose plate has a law of its own for each mode:

    >>> law = SkyLaw(plate={"field": (-1, 1), "pupil": (-0.5, 1)})
    >>> law.plate_law("pupil"), law.derotator_law("pupil")
    ((-0.5, 1.0), (0.0, 0.5))
    """

    plate: object = pointings.TRACKING
    # what keeps the pupil, or the image, still at a Nasmyth focus
    derotator: dict = field(default_factory=lambda: {"pupil": (0.0, 0.5), "field": (0.5, 0.5)})

    def __post_init__(self):
        # one law for all modes has the name ""
        given = self.plate if isinstance(self.plate, dict) else {"": self.plate}
        plate = {mode: _pair(f"plate {mode}".strip(), law) for mode, law in given.items()}
        turns = {mode: _pair(f"derotator {mode}", law) for mode, law in self.derotator.items()}
        if not plate:
            raise InstrumentError("plate = {}: at least one law is needed, (0, 0) if it stands")
        # a frozen instance is set once, here
        object.__setattr__(self, "plate", plate)
        object.__setattr__(self, "derotator", turns)
        # a mode of the plate that the derotator lacks could never be asked for
        lost = sorted(set(plate) - {""} - set(turns)) if turns else []
        if lost:
            raise InstrumentError(
                f"the plate has a law for {', '.join(lost)}, the derotator for {', '.join(turns)}"
            )

    @property
    def modes(self):
        """What the derotator may stabilize, or what the law of the plate depends on."""
        return tuple(self.derotator) or tuple(mode for mode in self.plate if mode)

    @property
    def plate_depends_on_mode(self):
        """Whether the law of the plate is another one in another mode."""
        # two modes with the same law need not be told apart
        return len(set(self.plate.values())) > 1

    def plate_law(self, mode=None):
        """
        Return the factors of parallactic angle and altitude in the plate's true angle.

        The ``mode``, what the derotator stabilizes, is needed where the law depends on it.
        """
        if mode is not None and self.modes:
            check_choice("mode", mode, self.modes, InstrumentError)
        if mode in self.plate:
            return self.plate[mode]
        if self.plate_depends_on_mode:
            check_choice("mode", mode, tuple(self.plate), InstrumentError)
        return next(iter(self.plate.values()))

    def derotator_law(self, mode):
        """Return the factors of parallactic angle and altitude in the derotator's angle."""
        if not self.derotator:
            raise InstrumentError("there is no derotator that follows the sky")
        check_choice("law", mode, tuple(self.derotator), InstrumentError)
        return self.derotator[mode]


def _pair(what, law):
    try:
        f, g = (float(number) for number in law)
    except (TypeError, ValueError):
        f = g = float("nan")
    if not (math.isfinite(f) and math.isfinite(g)):
        raise InstrumentError(
            f"{what}: {law!r} must be two numbers, factors of parallactic angle and altitude"
        )
    return f, g


#: What may be added, and the standard deviation of its prior, a normal around zero.
NUISANCES = {"background": 0.01, "beam_gain": 0.02, "lamp": 0.002}


def add_nuisance(chains, datasets, nuisance):
    """
    Return the chains with nuisance optics, one of each kind for each dataset.

    ``"background"``, light that is added at a constant flux: the share of it in a frame of median
    flux, one value per wavelength. ``"beam_gain"``, half the relative difference of the gains
    of the two beams, one value per wavelength; normalized double differences see it in second
    order only, single differences in first. ``"lamp"``, q and u of an internal source without
    polarizer, for all wavelengths; q cannot be distinguished from the diattenuation of a mirror
    that stands straight, except by the prior.

    Parameters
    ----------
    chains : sequence of `~astropy.modeling.CompoundModel`
        The chain of each dataset.
    datasets : sequence of Observations
        The datasets.
    nuisance : sequence of str
        Kinds, or ``"KIND:DATASET"`` for one dataset only.

    Returns
    -------
    list of `~astropy.modeling.CompoundModel`

    Raises
    ------
    InstrumentError
        If a kind or dataset is unknown, or ``"lamp"`` is asked for where there is no such source.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.instruments import add_nuisance
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 80] * u.deg)
    >>> lamp = simulate(charis.chain(), charis.wavelength, frames, name="night 1")
    >>> chain, = add_nuisance([charis.chain()], [lamp], ["background"])
    >>> [optic.name for optic in chain][-2:]
    ['background_night_1', 'wollaston']
    """
    chains, names = list(chains), [observations.name for observations in datasets]
    # names of optics must do as optic.parameter
    labels = [re.sub(r"\W+", "_", name) for name in names]
    # two tables may have one name, and a third the name that a number would make of it
    numbered = [f"{label}_{i + 1}" for i, label in enumerate(labels)]
    labels = [n if labels.count(t) > 1 else t for t, n in zip(labels, numbered, strict=True)]
    labels = labels if len(set(labels)) == len(labels) else numbered
    size = len(common_wavelengths(datasets))
    for text in nuisance:
        kind, _, wanted = str(text).partition(":")
        check_choice("nuisance", kind, NUISANCES, InstrumentError)
        if wanted:
            check_choice(f"nuisance {kind}: dataset", wanted, names, InstrumentError)
        chosen = [i for i, name in enumerate(names) if wanted in ("", name)]
        if kind == "lamp":
            polarized = (optics.LinearPolarizer, optics.PolarizedSource)
            chosen = [i for i in chosen if not isinstance(leaves(chains[i])[0], polarized)]
            if not chosen:
                raise InstrumentError(
                    f"nuisance {text}: no dataset is of an unpolarized internal source"
                )
        for i in chosen:
            chains[i] = _added(chains[i], datasets[i], kind, f"{kind}_{labels[i]}", size)
    return chains


def without_nuisance(chain):
    """Return a chain without the nuisance optics of its dataset."""
    prefixes = tuple(f"{kind}_" for kind in NUISANCES)
    found = leaves(chain)
    kept = [leaf for leaf in found if not str(leaf.name).startswith(prefixes)]
    return chain if len(kept) == len(found) else join(kept)


def _added(chain, observations, kind, name, size):
    found, prior, zero = leaves(chain), FrozenNormal(0.0, NUISANCES[kind]), np.zeros(size)
    split = next(i for i, leaf in enumerate(found) if leaf.splits_light)
    if kind == "lamp":
        source = optics.PolarizedSource(name=name)
        source.q.prior = source.u.prior = prior
        return join([source, *found])
    if kind == "beam_gain":
        # behind the splitter, where there are two beams
        gain = optics.BeamGain(imbalance=zero, name=name)
        gain.imbalance.prior = prior
        return join([*found[: split + 1], gain, *found[split + 1 :]])
    # the sum of both beams is 0 where it is masked
    flux = observations.position("total_flux")
    # in front of the splitter: background falls on both beams alike
    light = optics.StrayLight(
        amount=zero, reference=float(np.median(flux[flux > 0])), mount="total_flux", name=name
    )
    light.amount.prior = prior
    return join([*found[:split], light, *found[split:]])


class Instrument(ABC):
    """
    Base of all instruments; a subclass is one file.

    Attributes
    ----------
    name : str
        Short name, as on the command line.
    aliases : tuple of str
        Other spellings, as in the ``instrument`` entry of a table.
    wavelength : `~astropy.units.Quantity`
        Usual wavelengths, shape (n_wavelengths,).
    keywords : dict of str to str
        Column of the observation table to FITS header keyword.
    sources : tuple of str
        What may send the light; empty where the chain is the same for all.
    optional_optics : tuple of str
        Optics that are in the beam only sometimes.
    files : FileLayout or None
        How the instrument's FITS files look; None if they cannot be reduced here.
    headers : FileLayout or None
        How headers of its frames are read where its files cannot be reduced here: by ``keywords``,
        and those that are common in FITS files for date, coordinates and instrument.
    references : tuple of str
        Where the values come from.
    entrance : str
        The first optic downstream of the internal source, which a star's light meets after the
        telescope.
    sky_law : SkyLaw
        How half-wave plate and derotator follow the sky.
    sky_options : tuple of str
        Which of ``wavelength`` and ``date`` its ``telescope_optics`` take.
    max_age : `~astropy.units.Quantity`
        Age from which on a calibration counts as old.
    changes : tuple of (str or None, str, str, str)
        Dated changes that no calibration outlives: the optic that changed (None: all light is
        concerned), the first day on which it may have changed, the first on which it certainly
        had (both ISO), and the change in words.

    Examples
    --------
    A polarimeter with a half-wave plate and nothing else to choose:

    >>> from astropolcal import optics
    >>> from astropolcal.instruments import Instrument
    >>> class Simple(Instrument):
    ...     name, sources = "simple", ("polarized",)
    ...     def chain(self, source="polarized", optics_in=(), *, wavelength=None):
    ...         return (optics.LinearPolarizer(name="polarizer")
    ...                 | optics.LinearRetarder(mount="hwp", name="hwp")
    ...                 | optics.WollastonPrism(name="wollaston"))
    >>> Simple().chain().submodel_names
    ('polarizer', 'hwp', 'wollaston')
    """

    name = ""
    aliases = ()
    wavelength = None
    keywords = {}
    sources = ()
    optional_optics = ()
    files = None
    references = ()
    sky_options = ()
    entrance = "hwp"
    max_age = 365 * u.day
    changes = ()
    # what an instrument without a layout of its files says of headers and of its place
    transforms, times, site = {}, {}, ()

    @abstractmethod
    def chain(self, source="polarized", optics_in=(), *, wavelength=None, **options):
        """
        Return the chain for a source, with starting values, bounds and fixed flags.

        Parameters
        ----------
        source : str
            What sends the light, one of ``sources``.
        optics_in : sequence of str
            Which of ``optional_optics`` are in the beam.
        wavelength : `~astropy.units.Quantity`, optional
            Grid of the parameters given per wavelength, by default the usual one.
        **options
            Particular to the instrument. Most take ``star``, the name of the source optic of a
            star, and ``target``, the name of the star in the catalogue.

        Returns
        -------
        `~astropy.modeling.CompoundModel`

        Raises
        ------
        InstrumentError
            If a choice is unknown.
        """

    def setup(self, observations):
        """Return ``source`` and ``optics_in`` of a dataset, from its table's meta.

        Here the source that they state, and no optional optics.

        Raises
        ------
        InstrumentError
            If the table does not say.
        """
        return self.source_of(observations), ()

    def check_choices(self, source, optics_in=(), **choices):
        """
        Raise if what `chain` is asked for is not known, the first thing that it does.

        ``choices`` are other choices by name, each with its value and what is allowed; the message
        names the instrument, the value and what is allowed.
        """
        check_choice(f"{self.name}: source", source, self.sources, InstrumentError)
        for name in optics_in:
            check_choice(f"{self.name}: optics_in", name, self.optional_optics, InstrumentError)
        for what, (value, allowed) in choices.items():
            check_choice(f"{self.name}: {what}", value, allowed, InstrumentError)

    def grid(self, wavelength=None):
        """Return the wavelengths of the parameters of a chain, by default the usual ones."""
        return self.wavelength if wavelength is None else np.atleast_1d(wavelengths_of(wavelength))

    def source_of(self, observations, spellings=None):
        """
        Return the source that a table's meta state, for `setup`.

        ``spellings`` lead from what tables may call the sources to the names; case, hyphens and
        underscores do not matter, and a ``"standard star"`` is a ``"star"``.
        """
        allowed = {name: name for name in self.sources} if spellings is None else spellings
        known = {tables.plain_source(word): name for word, name in allowed.items()}
        word = tables.plain_source(observations.source)
        if word not in known:
            what = f"{observations.name}: source of the table's meta"
            check_choice(what, observations.source, allowed, InstrumentError)
        return known[word]

    def meta_without(self, names):
        """Return what the meta of a table say when these optional optics are out of the beam."""
        return {}

    def optics_of(self, header):
        """Return what a header tells of optional optics: name to whether it is in the beam."""
        return {}

    def configured(self, header):
        """
        Return the instrument as a frame's mode has it, with wavelengths and shape of its files.

        Here the same: files of one kind only; an unknown mode raises an InstrumentError.
        """
        return self

    def mode_header(self, wavelength):
        """Return the keywords by which `configured` knows cubes of some wavelengths."""
        return {}

    def published(self):
        """Return the chain with published values, for simulations and examples."""
        raise InstrumentError(f"{self.name}: no published values; give a calibration file")

    def published_meta(self):
        """Return the meta of a table taken with the chain of `published`."""
        return {"instrument": self.name}

    def published_mirrors(self):
        """Return published mirrors to compare with: name of the optic to label to optic."""
        return {}

    def chains_for(self, datasets, *, nuisance=(), exact=False, **options):
        """
        Return one chain per dataset, all on the common wavelength grid.

        Parameters
        ----------
        datasets : sequence of Observations
            The datasets.
        nuisance : sequence of str
            What to add to the chain of each dataset, see `~astropolcal.instruments.add_nuisance`:
            ``"background"``, ``"beam_gain"``, ``"lamp"``.
        exact : bool
            Whether the polarization of standard stars and the orientation of fixed optics are
            held at what is known of them, as in the published calibrations; by default they have
            the errors of the catalogue and of the mounting as priors.
        **options
            Passed to `chain`.

        Returns
        -------
        list of `~astropy.modeling.CompoundModel`

        Raises
        ------
        InstrumentError
            If a table belongs to another instrument, or does not say what it is.
        """
        datasets = list(datasets)
        known = inspect.signature(self.chain).parameters
        # before any table is read: a wrong word of the command line is the likelier mistake
        unknown = sorted(set(options) - set(known))
        if unknown and not any(p.kind is p.VAR_KEYWORD for p in known.values()):
            raise InstrumentError(f"{self.name}: its chain has no option {', '.join(unknown)}")
        for observations in datasets:
            self.check(observations)
        # one grid for all: what datasets share has one value for each wavelength of any of them
        grid = (common_wavelengths(datasets) * u.um).to(u.nm)
        setups = [self.setup(observations) for observations in datasets]
        particulars = [self.particulars(observations) for observations in datasets]
        chains = [
            self.chain(source, optics_in, wavelength=grid, **own, **options)
            for (source, optics_in), own in zip(setups, particulars, strict=True)
        ]
        for leaf in (leaf for chain in chains for leaf in leaves(chain)):
            for parameter in (getattr(leaf, key) for key in leaf.param_names):
                parameter.wavelength = grid if parameter.size == grid.size > 1 else None
        return add_nuisance(map(shared.as_exact, chains) if exact else chains, datasets, nuisance)

    def telescope_optics(self, behind, **options):
        """
        Return what stands between sky and half-wave plate when a star is observed.

        Parameters
        ----------
        behind : list of Optic
            The optics from the half-wave plate on, whose wavelengths the telescope must have.
        **options
            Particular to the instrument, see ``sky_options``.

        Returns
        -------
        list of Optic
            With a rotator on the stage ``parallactic``.

        Raises
        ------
        InstrumentError
            If the instrument has no telescope of known values.
        """
        raise InstrumentError(f"{self.name}: no chain from the sky is known")

    @property
    def headers(self):
        """Layout that reads the headers of frames, None without keywords."""
        own = self.keywords | self.times
        common = {key: word for key, word in COMMON.items() if word not in own.values()}
        common.pop("exposure_time", None)
        return FileLayout(common | own, (1, 1, 1), transforms=self.transforms) if own else None

    @property
    def has_telescope(self):
        """Whether `on_sky` can put a telescope before an internal chain."""
        own, base = type(self), Instrument
        # an instrument may build the whole chain itself
        return own.on_sky is not base.on_sky or own.telescope_optics is not base.telescope_optics

    def on_sky(self, chain, **options):
        """
        Return the chain of a star that has the optics of an internal chain.

        The source goes, with what stands before the half-wave plate and does not turn with it;
        ``telescope_optics`` come in their place.

        Parameters
        ----------
        chain : `~astropy.modeling.CompoundModel`
            A chain; one with the telescope already only loses the nuisance optics of its dataset.
        **options
            Passed to `~astropolcal.instruments.Instrument.telescope_optics`.

        Returns
        -------
        `~astropy.modeling.CompoundModel`
            Without a source, which is of each star.

        Raises
        ------
        ChainError
            If the chain has no half-wave plate.
        InstrumentError
            If the instrument has no telescope of known values.

        Examples
        --------
        >>> from astropolcal import instruments
        >>> charis = instruments.get("charis")
        >>> [optic.name for optic in charis.on_sky(charis.published())][:4]
        ['parallactic', 'm3', 'altitude', 'hwp']
        """
        if not self.has_telescope:
            raise InstrumentError(f"{self.name}: no chain from the sky is known")
        chain = without_nuisance(chain)
        if "parallactic" in stages(chain):
            return chain
        found = leaves(chain)
        start = next((i for i, leaf in enumerate(found) if leaf.name == self.entrance), None)
        if start is None:
            raise ChainError(
                f"{self.name}: the chain has no optic {self.entrance!r} to put the telescope before"
            )
        _, behind = parted(found, start)
        return join([*self.telescope_optics(behind, **options), *behind])

    def _from_sky(self, chain, **known):
        """Return the same of what is known of a chain, as far as ``sky_options`` ask for it."""
        return self.on_sky(chain, **{key: known[key] for key in self.sky_options})

    def particulars(self, observations):
        """
        Return options of `chain` that differ between datasets, such as the name of a star.

        Parameters
        ----------
        observations : Observations
            The dataset.

        Returns
        -------
        dict
            Here of a star ``star``, the name of its source optic, and ``target``, as far as
            `chain` takes them.
        """
        if not tables.is_star(observations.source):
            return {}
        known, told = inspect.signature(self.chain).parameters, shared.star_options(observations)
        return {key: value for key, value in told.items() if key in known}

    def prepare(self, observations):
        """
        Return the observations with the frames masked that no calibration should use.

        Saturated frames; for an internal source those of an unstable lamp; for a star
        those of incomplete half-wave-plate cycles. Each mask has its reason and a warning.

        Parameters
        ----------
        observations : Observations
            The dataset.

        Returns
        -------
        Observations

        Raises
        ------
        ObservationError
            If a star has no pointing, or nothing would be left.
        """
        observations = tables.mask_saturated(observations)
        if not tables.is_star(observations.source):
            return tables.mask_unstable_lamp(observations)
        # raises here, with the name of the table, rather than in the middle of a fit
        pointings.sky_angles(observations, self.location)
        # on sky seeing and transparency change within seconds: only whole cycles cancel them
        return tables.mask_incomplete_cycles(observations)

    @property
    def location(self):
        """Site of the telescope, an `~astropy.coordinates.EarthLocation`, or None."""
        return pointings.location_of(self.site or getattr(self.files, "site", ()))

    @property
    def sky_law(self):
        """How plate and derotator follow the sky; here that of Subaru, or of the file layout."""
        return SkyLaw() if self.files is None else SkyLaw(plate=self.files.tracking)

    def plate_law(self, observations):
        """
        Return the tracking law of the half-wave plate for a dataset.

        Parameters
        ----------
        observations : Observations
            Where the law depends on what the derotator stabilizes, ``tracking`` in its meta
            names that.

        Returns
        -------
        (float, float)
            Factors of parallactic angle and altitude.

        Raises
        ------
        InstrumentError
            If the table has neither the true angle of the plate, ``hwp_true``, nor says which law
            it is.

        Examples
        --------
        >>> from astropolcal import instruments
        >>> from astropolcal.observations import Observations, example_table
        >>> instruments.get("charis").plate_law(Observations.from_table(example_table()))
        (0.5, 1.0)
        """
        law, stated = self.sky_law, observations.meta.get("tracking")
        if not law.plate_depends_on_mode:
            return law.plate_law()
        if stated in law.modes:
            return law.plate_law(stated)
        if stated is None and "hwp_true" in observations.frame_columns:
            # the law then only tells how the plate moves within an exposure
            return law.plate_law(law.modes[0])
        raise InstrumentError(
            f"{observations.name}: tracking is {stated!r} in the table's meta; without a column "
            f"hwp_true it must be one of {', '.join(law.modes)}"
        )

    def check(self, observations):
        """Raise InstrumentError if the table names another instrument."""
        stated = observations.instrument
        if stated is not None and not self.answers_to(stated):
            raise InstrumentError(
                f"{observations.name}: the table is of instrument {stated!r}, not {self.name!r}"
            )

    def answers_to(self, name):
        """Return whether ``name`` is this instrument, ignoring case."""
        # headers and observers write the same name in capitals or not
        return name.lower() in {self.name.lower(), *(alias.lower() for alias in self.aliases)}

    def positions(self, observations, chain, **exposure):
        """
        Return the position of every stage of the chain in each frame, in radian.

        In a chain with stages "parallactic" or "altitude" the half-wave plate follows the sky, by
        the instrument's law or as the column ``hwp_true`` tells; elsewhere the columns count.

        Parameters
        ----------
        observations : Observations
            The dataset.
        chain : Optic or `~astropy.modeling.CompoundModel`
            The chain.
        **exposure
            For the motion during an exposure: the number of Gauss-Legendre ``nodes``, ``when`` in
            it the angles hold ("start", "middle", "end"), and ``duty``, the share of the time in
            which light is collected.

        Returns
        -------
        dict of str to `~numpy.ndarray`
            Shape (n_frames,) each, or (nodes, n_frames) for exposures of several nodes, and for one
            if the angles do not hold in the middle.

        Raises
        ------
        ObservationError
            If a column is missing, or a star has no pointing.
        """
        wanted, sky = stages(chain), {}
        if {"parallactic", "altitude"} & set(wanted):
            # the caller may know the law better, as a diagnosis that tries another sign
            exposure = {"law": self.plate_law(observations)} | exposure
            sky = pointings.sky_positions(observations, self.location, **exposure)
            # the table need not have the parallactic angle as a column
            steady = sky["parallactic"].reshape(-1, observations.n_frames).mean(axis=0)
            sky["parallactic_rate"] = pointings.angle_change(observations, steady)
        # the pointing tells some of the stages, columns of the table the others
        return {s: sky[s] if s in sky else observations.position(s) for s in wanted}

    def __repr__(self):
        return f"<{type(self).__name__} {self.name!r}>"


# ---- what most instruments share -----------------------------------------------------------


class Polarimeter(Instrument):
    """An instrument whose chain is a source, or a star and the telescope, and its own optics.

    Attributes
    ----------
    site : tuple of float
        Longitude and latitude (deg) and height (m) of the telescope; empty without a site.
    focus : str
        ``"nasmyth"``, with a tertiary mirror of bare aluminium, or ``"cassegrain"``, where the sky
        turns upstream of the instrument and nothing else.
    altitude : str
        The stage of the altitude at a Nasmyth focus, with its sign.
    transforms : dict
        Of the keywords, see `~astropolcal.instruments.FileLayout`.
    times : dict
        Keywords of the time of a frame, where they are not the usual ones.
    """

    sources = ("polarized", *shared.STARS)
    sky_options = ("wavelength",)
    focus, altitude = "nasmyth", "-altitude"
    #: The plate stays where it is put, and turns with the instrument.
    sky_law = SkyLaw(plate=(0, 0), derotator={})

    def chain(self, source=None, optics_in=(), *, wavelength=None, star="star", target=None):
        """Return the chain of a source upstream of the instrument or of a star, to be calibrated.

        As `Instrument.chain`. The first of ``sources`` is the default; ``"polarized"`` is a
        polarizer upstream of the instrument, ``"unpolarized"`` a lamp without one, all others are
        stars.
        """
        source = self.sources[0] if source is None else source
        self.check_choices(source, optics_in)
        grid = self.grid(wavelength)
        return join([*self.light(source, grid, star, target), *self.inner(source, optics_in, grid)])

    def light(self, source, grid, star, target):
        """Return the polarizer, or a star and the telescope."""
        if source == "polarized":
            return [optics.LinearPolarizer(name="polarizer")]
        light = shared.star_source(source, grid, star, target)
        return [light, *self.telescope_optics(wavelength=grid)]

    @abstractmethod
    def inner(self, source, optics_in, grid):
        """Return the optics from the entrance of the instrument on."""

    def telescope_optics(self, behind=(), *, wavelength=None):
        """Return the telescope of the focus."""
        if self.focus == "cassegrain":
            return [optics.Rotator(mount="parallactic", name="parallactic")]
        return shared.telescope(aluminium(self.grid(wavelength)), self.altitude)


class SubaruPolarimeter(Instrument):
    """
    What stands downstream of Subaru's tertiary mirror, half-wave plate and derotator.

    Sources are those of the calibration unit upstream of the plate, and stars. Free are what is
    free of CHARIS, from the same starts.
    """

    sources = (*shared.INTERNAL, *shared.STARS)
    sky_options = ()
    site = shared.SITE
    changes = shared.CHANGES
    keywords = {
        "hwp": "RET-ANG1",
        "hwp_true": "RET-POS1",
        "derotator": "D_IMRANG",
        "altitude": "ALTITUDE",
    }
    times = {"mjd": "MJD", "time": "UT"}
    sky_law = SkyLaw()

    def chain(
        self,
        source="polarized",
        optics_in=(),
        *,
        wavelength=None,
        derotator="elliptical",
        bounds="physical",
        m3="free",
        star="star",
        target=None,
    ):
        """
        Return the chain of an internal source or a star, ready to be calibrated.

        Parameters
        ----------
        source : str
            ``"polarized"`` or ``"unpolarized"``: internal source with or without its
            polarizer; without it the fold mirror's diattenuation is a free parameter for each
            wavelength. ``"unpolarized standard star"``: a star of zero polarization, downstream of
            the telescope's tertiary mirror. ``"polarized standard star"`` or ``"star"``: the star's
            q and u are free parameters for each wavelength, in the frame of the sky.
        optics_in : sequence of str
            Optional optics in the beam.
        wavelength : `~astropy.units.Quantity`, optional
            Grid, by default that of the instrument.
        derotator : {"elliptical", "linear", "kmirror"}
            Elliptical as in the paper, linear as in the calibrations before, or three silver
            mirrors with films of silica: their thickness and factors on n and k of silver are
            free, the factors with normal priors of 0.5 and 0.1 around 1.
        bounds : {"physical", "paper"}
            Retardances within 360 deg of zero, or within the paper's bounds (0 to 360 deg in the
            published signs). Either way thicknesses are within 0.6 to 1.4 of 't Hart's,
            misalignments within 5 deg, efficiencies between 0 and 1.
        m3 : {"free", "power law", "metal"}
            Tertiary mirror of a star's chain: a diattenuation per wavelength, the paper's
            permittivity, or silver with a film.

        Others, and what is returned and raised, are as in `Instrument.chain`.

        Examples
        --------
        >>> from astropolcal import instruments
        >>> chain = instruments.get("charis").chain(derotator="linear")
        >>> chain["derotator"].retardance.shape
        (22,)
        """
        known = {"derotator": (derotator, shared.DEROTATORS), "bounds": (bounds, shared.BOUNDS)}
        self.check_choices(source, optics_in, m3=(m3, shared.M3_MODELS), **known)
        grid = self.grid(wavelength)
        train = shared.entrance(source, grid, star, target, m3)
        train.append(shared.two_layer_plate(**shared.misaligned(0)))
        train.append(shared.published_derotator(grid, derotator, bounds))
        return join([*train, *self.camera(optics_in, grid)])

    def camera(self, optics_in, grid):
        """Return the optics downstream of the derotator, here a Wollaston prism."""
        return [optics.WollastonPrism(efficiency=np.full(grid.size, 0.985), name="wollaston")]

    def telescope_optics(self, behind=(), **options):
        """Return the telescope with the tertiary mirror that is published."""
        return shared.telescope(shared.published_mirror())


def aluminium(grid):
    """Return a tertiary mirror whose diattenuation, at first that of aluminium, is free."""
    metal = optics.MetalMirror(material="aluminium")
    return shared.free_mirror("m3", metal.diattenuation(grid), metal.retardance(grid), most=0.1)
