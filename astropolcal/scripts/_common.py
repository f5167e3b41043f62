# Licensed under a 3-clause BSD style license - see LICENSE
"""What the subcommands share: options, outputs, datasets, edits of the chains."""

import argparse
import inspect
import json
import os
import re
import shlex
import stat
import sys
import textwrap
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord

from astropolcal import instruments
from astropolcal.chain import find_optic, leaves, remove_optic
from astropolcal.exceptions import AstropolcalError, InstrumentError, ParameterError, warn
from astropolcal.files import atomic_path, check_kind, one_line, plain, printable
from astropolcal.observations import Observations
from astropolcal.observations.pointings import sky_angle
from astropolcal.progress import clear
from astropolcal.units import plain_number
from astropolcal.words import HEIGHT, WIDTH, counted, listed, shortened

# the first bytes of files that may be taken for tables, and where they belong instead
_NO_TABLES = {
    b"#ASDF": "an ASDF file, such as a calibration, where an observation table (ECSV) is wanted; "
    "a calibration goes to info, diagnose, sample, efficiency, correct --calibration or "
    "calibrate --start",
    b"SIMPLE  =": "a FITS file, where an observation table (ECSV) is wanted; reduce makes one of "
    "cubes",
}

# endings of a page
PAGES = (".html", ".htm")
# those of figures that matplotlib writes
_FIGURES = "png pdf svg svgz jpg jpeg webp avif gif tif tiff eps ps pgf raw rgba".split()

# ---- files that are named -------------------------------------------------------------------


class Input(str):
    """Type of an argument: a file to read, or a folder of calibrations."""

    kinds = re.compile(r"\.asdf$")


class Frames(Input):
    """Type of an argument: a FITS file to read, or a folder of them."""

    kinds = re.compile(r"\.(fits|fit$|fts$)", re.IGNORECASE)


class Output(str):
    """Type of an argument: a file to write; ``-`` is the standard output."""


class Continued(Output):
    """Type of an argument: a file that is read, if it exists, and written further."""


class Drawing(Output):
    """Type of an argument: a file in which matplotlib draws a figure."""


class Folder(Output):
    """Type of an argument: a folder in which files of some kinds are written."""

    kinds = re.compile(r"\.(png|fits)$")


def check_paths(arguments):
    """
    Refuse files that cannot be read or written, and outputs that are inputs or one another.

    Before anything runs: hours of fitting must not end with a file that cannot be written.
    """
    inputs, outputs = _named(arguments, Input), _named(arguments, Output)
    for _, path in [*inputs, *_named(arguments, Continued)]:
        _seen(path, path, "read", os.listdir if os.path.isdir(path) else os.stat)
        check_kind(path)
    for option, path in outputs:
        _check_output(path)
        if isinstance(path, Drawing):
            check_suffix(label_of(option), path, *(f".{kind}" for kind in _FIGURES))
    inputs += [(o, left) for o, path in _named(arguments, Frames) for left in _left_files(path)]
    replaced = getattr(arguments, "may_replace", {})
    for number, (option, path) in enumerate(outputs):
        label = label_of(option)
        # what is written to a folder is of another kind than what is read from it
        for name, other in [] if isinstance(path, Folder) else inputs:
            if name == replaced.get(option):
                continue
            if _are_same(path, other):
                raise AstropolcalError(
                    f"{label} {path}: would overwrite the input {other}; name another file"
                )
            if os.path.isdir(other) and (_is_within(path, other) or _holds(other, path)):
                raise AstropolcalError(
                    f"{label} {path}: is one of the files that are read from {other}; name "
                    "another folder"
                )
        for name, other in outputs[:number]:
            if _collide(path, other) or _collide(other, path):
                raise AstropolcalError(
                    f"{label} {path}: cannot be written beside {label_of(name)} {other}, "
                    "which takes the same name; name another file"
                )


def _named(arguments, kind):
    """Return the options of a kind and their files; one a file, where there may be several."""
    several = ((o, v if isinstance(v, list) else [v]) for o, v in vars(arguments).items())
    return [(o, path) for o, v in several for path in v if isinstance(path, kind) and path != "-"]


def _left_files(path):
    """Return the files of left beams that are read with a file of a right beam."""
    layouts = [instruments.get(name).files for name in instruments.names()]
    pairs = [layout for layout in layouts if layout is not None and layout.beam_files]
    name = Path(path).name if os.path.isfile(path) else ""
    return [Input(layout.left_file(path)) for layout in pairs if layout.beam_files[0] in name]


def label_of(option):
    """Return how an option is typed."""
    return "-o" if option == "output" else f"--{option.replace('_', '-')}"


def _seen(path, place, done, look=os.stat):
    """Return what the system says of a place, None where there is nothing."""
    try:
        return look(place)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as problem:
        reason = getattr(problem, "strerror", None) or f"it is not the name of a file ({problem})"
        raise AstropolcalError(f"{path}: cannot be {done}: {reason}") from None


def _check_output(path):
    if isinstance(path, Folder):
        # it is made later, inside the nearest folder that exists
        place = next(p for p in [Path(path), *Path(path).absolute().parents] if os.path.exists(p))
        if not os.path.isdir(place):
            raise AstropolcalError(f"{place}: is a file, not a folder")
        for part in Path(path).parts:
            # names that are too long there
            _seen(path, Path(place, part), "written")
        places = [place]
    else:
        state = _seen(path, path, "written")
        if state is not None and stat.S_ISDIR(state.st_mode):
            raise AstropolcalError(f"{path}: is a folder, not a file")
        # a link stays a link, and what it points to is replaced
        folder = Path(os.path.realpath(path) if os.path.islink(path) else path).parent
        if not os.path.isdir(folder):
            raise AstropolcalError(f"{path}: there is no folder {folder}")
        places = [path, folder] if state is not None and isinstance(path, Continued) else [folder]
        if state is not None and not stat.S_ISREG(state.st_mode):
            # a pipe or a device takes what it is given, and no file is made beside it
            places = [path]
    for place in places:
        if not os.access(place, os.W_OK | (os.X_OK if os.path.isdir(place) else 0)):
            raise AstropolcalError(
                f"{path}: no permission to write to {place}; name a folder that you may write to"
            )


def _collide(path, other):
    """Return whether what is written to one path would be lost, or not be written, for another."""
    if isinstance(path, Folder):
        return not isinstance(other, Folder) and _is_within(other, path)
    # a file is no folder in which another could be
    inside = os.path.realpath(other).startswith(os.path.realpath(path) + os.sep)
    return _are_same(path, other) or inside


def _holds(folder, path):
    """Return whether an existing file is, by any name, one of those that belong in a folder."""
    names = (name for name in os.listdir(folder) if folder.kinds.search(name))
    return os.path.isfile(path) and any(_are_same(path, os.path.join(folder, n)) for n in names)


def _is_within(path, folder):
    """Return whether a file lies in a folder and has a name of the kinds that belong there."""
    place, name = os.path.split(os.path.realpath(path))
    return place == os.path.realpath(folder) and bool(folder.kinds.search(name))


def _are_same(path, other):
    """Return whether two names are of one file, which need not exist; devices take everything."""
    if not os.path.exists(path):
        return os.path.realpath(path) == os.path.realpath(other)
    plain = os.path.isfile(path) or os.path.isdir(path)
    return plain and os.path.exists(other) and os.path.samefile(path, other)


# ---- options --------------------------------------------------------------------------------


def texts_of(docstring):
    """Return what a parser says of a command, whose module has this docstring."""
    description, _, examples = inspect.cleandoc(docstring or "").partition("\n\nFor example::\n\n")
    first = description.partition(".\n")[0]
    texts = {"help": first[:1].lower() + first[1:], "description": description}
    # texts are shown as they are written
    form = argparse.RawDescriptionHelpFormatter
    return texts | {"epilog": f"examples:\n{examples}", "formatter_class": form}


def add_command(commands, name, module):
    """Add the subcommand that a module has in its docstring, ``OPTIONS`` and ``run``."""
    parser = place = commands.add_parser(name, **texts_of(module.__doc__))
    parser.set_defaults(run=module.run, **getattr(module, "DEFAULTS", {}))
    for entry in entries(module.OPTIONS):
        if entry.startswith("["):
            place = parser.add_argument_group(entry.strip("[]"))
            continue
        flags, settings, together = option(entry, getattr(module, "TYPES", {}))
        place.add_argument(*flags, **settings).together = together


def entries(text):
    """Yield the entries of a text of options; ``@ json quiet`` stands for options of `_SHARED`."""
    # further lines of an entry are indented
    for entry in re.split(r"\n(?! )", text.strip()):
        if entry.startswith("@"):
            yield from (_SHARED[name] for name in entry[1:].split())
        else:
            yield entry


def option(entry, types):
    """Return names, settings of ``add_argument`` and companions that an entry describes.

    Before two spaces stand names and value as the help shows them, such as ``-o --output FILE`` or
    ``--kind {a,b}``; the name of a type; ``=DEFAULT``; ``required``; ``?``, ``*`` or ``+`` as in
    ``nargs``; ``...`` if it may be repeated; ``needs:NAME`` and ``not:NAME`` for `check_together`.
    After them stands what it means. An option that takes no value is a switch.
    """
    form, _, meaning = entry.partition("  ")
    flags, settings, together = [], {"help": " ".join(meaning.split())}, []
    known = _TYPES | types
    for word in form.split():
        if word.startswith("-") or not flags:
            flags.append(word)
        elif word.startswith("{"):
            settings["choices"] = word[1:-1].split(",")
        elif word.startswith("="):
            settings["default"] = settings.get("type", str)(word[1:])
        elif word == "required":
            settings["required"] = True
        elif word in ("?", "*", "+"):
            settings["nargs"] = word
            if word == "*":
                settings.setdefault("default", [])
        elif word == "...":
            several = {"action": "append", "default": []}
            settings |= {"action": "extend"} if "nargs" in settings else several
        elif word.startswith(("needs:", "not:")):
            together.append(word.split(":"))
        elif word in known:
            settings["type"] = known[word]
        else:
            settings |= {"metavar": word} | ({"type": _pair} if "=" in word else {})
    if flags[0].startswith("-") and len(settings) == 1:
        settings["action"] = "store_true"
    return flags, settings, together


def check_together(actions, arguments):
    """Refuse options without one that they need, or beside one that they contradict."""
    known = {action.dest: action for action in actions}
    given = [a for a in actions if getattr(arguments, a.dest, a.default) != a.default]
    for action in given:
        for rule, name in getattr(action, "together", ()):
            # a shared option has companions that some commands do not have
            if name in known and (known[name] in given) == (rule == "not"):
                words, value = label_of(action.dest), getattr(arguments, action.dest)
                if not isinstance(value, bool | list):
                    words += f" {value}".removesuffix(".0")
                words += " cannot be combined with" if rule == "not" else " needs"
                other = known[name]
                choices = (c for c in other.choices or () if c != other.default)
                values = other.metavar or "|".join(choices)
                raise ParameterError(" ".join([words, *other.option_strings[-1:], values]))


def _pair(text):
    """Return a name and its value without the spaces around them."""
    return "=".join(part.strip() for part in text.split("=", 1))


#: Options of an instrument's chains; only what was typed, as not every instrument knows all.
MODEL = ("derotator", "bounds", "m3", "plate")


def stated_model(arguments):
    """Return the options of an instrument's chains that were typed."""
    return {key: value for key in MODEL if (value := getattr(arguments, key)) is not None}


#: Options that several commands have, by name; ``online`` is obeyed by `astropolcal.scripts.main`.
_SHARED = """
--derotator MODEL not:start  elliptical (default) or linear retarder, or kmirror: three silver
    mirrors with films
--bounds KIND not:start  physical (default), or those of the paper
--m3 MODEL not:start  tertiary mirror of stars: free (default, a diattenuation per wavelength),
    'power law' (the paper's permittivity) or metal (silver with a film)
--plate MODEL not:start  half-wave plate of VAMPIRES: free (default, a retardance per band) or
    two-layer (one law for all bands)
--full  print everything; by default what fits a terminal of 80 columns and 24 lines
--json FILE Output  write a summary for machines (- for stdout)
--online  fetch new tables of the Earth's rotation; by default the network is not used
-q --quiet  print only warnings and errors
--plots DIR Folder  save the figures in this folder
--archive DIR Folder  work on all sequences in the folders that are named and in those inside, and
    write products, index and manifest to this folder; what is there already is not done again
--gap MINUTES float =30 needs:archive  with --archive: time without a frame after which another
    sequence begins (default: 30)
--cycles N int needs:archive  with --archive: cut sequences after so many cycles of the half-wave
    plate
--target PATTERN needs:archive  with --archive: only objects such as 'HD*'
--retry needs:archive  with --archive: try the sequences that failed again
--timeout MINUTES float needs:archive  with --archive: give a sequence up after this time
--fix NAME[=VALUE] ... not:start  hold a parameter, such as hwp.theta=0 or hwp.theta=0.1deg
--free NAME ...  free a parameter, such as wollaston.theta
--without OPTIC ... not:start  take an optic out of the model
"""
_SHARED = {re.search(r"--(\w+)", entry)[1]: entry for entry in entries(_SHARED)}


def numbers(text, count=None, separator=","):
    """Return the numbers of a text, which are finite and ``count``; or raise ValueError."""
    found = [plain_number(part) for part in text.split(separator)]
    if count not in (None, len(found)) or not np.isfinite(found).all():
        raise ValueError(f"{text!r} is not {count or 'a list of'} finite numbers")
    return found


def _angles(text, count=None):
    """Return the angles of a text; beyond two turns, which no encoder counts, is a slip."""
    found = numbers(text, count)
    if np.abs(found).max() > 720:
        raise ValueError(f"{text!r} is not an angle")
    return found


def text_type(words, read, *arguments):
    """Return the type of an option: what ``read`` makes of a text, which else is not ``words``."""

    def convert(text):
        with suppress(ValueError):
            return read(text, *arguments)
        raise argparse.ArgumentTypeError(f"{text!r} is not {words}")

    return convert


def sky_position(text, option):
    """Return the position that RA,DEC mean; of names a server would have to be asked."""
    try:
        right_ascension, declination = text.split(",")
        angles = sky_angle("right_ascension", right_ascension), sky_angle("", declination)
        if not text.isascii():
            raise ValueError
        return SkyCoord(*angles, unit=u.deg)
    except (ValueError, u.UnitsError):
        raise ParameterError(
            f"{option} {text}: give RA,DEC in degrees, or as 05:26:06,+16:42:00; allowed are "
            "a right ascension from -360 to 360 deg and a declination from -90 to 90 deg"
        ) from None


def number_or(*words, kind=float):
    """Return the type of an option that takes one of some words or a number."""

    def read(text):
        return text if text in words else _NUMBERS[kind](text)

    return text_type(f"{', '.join(words)} or a number", read)


_NUMBERS = {float: lambda text: numbers(text, 1)[0], int: partial(plain_number, kind=int)}
_TYPES = {
    "angle": text_type("an angle from -720 to 720 deg", lambda text: _angles(text, 1)[0]),
    "angles": text_type("a list of angles from -720 to 720 deg", _angles),
}
_TYPES["float"] = text_type("a finite number", _NUMBERS[float])
_TYPES["int"] = text_type("a whole number", _NUMBERS[int])
_TYPES |= {kind.__name__: kind for kind in (Input, Frames, Output, Continued, Drawing, Folder)}


# ---- outputs --------------------------------------------------------------------------------


def is_quiet(arguments):
    """Return whether nothing is printed: as asked for, or because the JSON goes to stdout."""
    return arguments.quiet or arguments.json == "-"


def show(text, file=None):
    """Print lines; names of files may hold what a terminal would act on."""
    clear()
    print(printable(text), file=file, flush=file is not None)


def say(arguments, *lines):
    """Print lines unless nothing is to be printed."""
    if not is_quiet(arguments):
        show("\n".join(lines))


def check_suffix(option, path, *suffixes):
    """Raise if a file that is to be written is called what others take for another format."""
    if path is not None and Path(path).suffix.lower() not in suffixes:
        raise AstropolcalError(f"{option} {path}: the name must end with {listed(suffixes, 'or')}")


def wrapped(line, indent=0):
    """Break a line at 80 columns, the further ones indented; words stay whole."""
    whole = {"break_long_words": False, "break_on_hyphens": False}
    return textwrap.fill(line, WIDTH, subsequent_indent=" " * indent, **whole)


def write_json(content, path):
    """Write a dictionary as JSON, atomically; ``-`` is the standard output."""
    text = json.dumps(plain(content, f"JSON of {path}"), indent=1, allow_nan=False) + "\n"
    if str(path) == "-":
        sys.stdout.write(text)
        return
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def give(arguments, lines, content, *written):
    """Write what machines want, and print lines and the files that were written, as asked for."""
    if arguments.json:
        write_json(content, arguments.json)
    last = written_lines(written)
    say(arguments, *lines, *([""] if last else []), *last)


def calibrated_instrument(calibration, path, name):
    """Return the instrument of a calibration; it has to be the one that was named, if it was."""
    own = calibration.instrument
    if not (name or own):
        raise InstrumentError(f"{path}: names no instrument; give --instrument NAME")
    instrument = instruments.get(name or own)
    if own and not instrument.answers_to(own):
        words = f"the calibration is of instrument {own!r}, not {instrument.name!r}"
        raise InstrumentError(f"{path}: {words}")
    return instrument


def write_calibration(calibration, arguments, content):
    """Write calibration, figures and what ``content()`` returns as asked for; say so in lines."""
    figures, kept = [], ["Not kept: -o cal.asdf writes the calibration to a file"]
    if arguments.output:
        calibration.write(arguments.output, overwrite=True)
        kept = []
    if arguments.plots:
        from astropolcal.plotting import save_all

        figures = save_all(calibration, arguments.plots)
    if arguments.json:
        write_json(content(), arguments.json)
    return written_lines([arguments.output, arguments.json], len(figures), arguments.plots) + kept


# ---- inputs ---------------------------------------------------------------------------------


def cube_files(paths):
    """Return the files, and those in the folders, that are named."""
    found = []
    for path in map(Path, paths):
        inside = sorted(path.glob("*.fits*")) if path.is_dir() else [path]
        if not inside:
            raise AstropolcalError(f"{path}: no FITS file in this folder")
        found += inside
    return found


def instrument_of(arguments, datasets):
    """Return the instrument that is asked for, or the one that the first table names."""
    first = datasets[0]
    if arguments.instrument:
        return instruments.get(arguments.instrument)
    if first.instrument is None:
        raise InstrumentError(
            f"{first.name}: the table names no instrument; give --instrument NAME"
        )
    try:
        return instruments.get(first.instrument)
    except InstrumentError as error:
        # the name was not typed by the user, who must know where it stands
        raise InstrumentError(
            f"{first.path or first.name}: {error}; --instrument NAME takes another one"
        ) from None


def read_datasets(paths):
    """Read observation tables; refuse one that is given twice."""
    datasets = []
    for path in paths:
        for mark, words in _NO_TABLES.items():
            if begins(path, mark):
                raise AstropolcalError(f"{path}: is {words}")
        dataset = Observations.read(path)
        for other, known in zip(paths, datasets, strict=False):
            # by content: the same frames under two names would count twice in a fit
            if known.content_hash == dataset.content_hash:
                raise AstropolcalError(f"{path}: holds the same frames as {other}")
        datasets.append(dataset)
    return datasets


def begins(path, mark):
    """Return whether a file begins with these bytes; what cannot be opened its reader says."""
    try:
        with open(path, "rb") as stream:
            return stream.read(len(mark)) == mark
    except OSError:
        return False


# ---- the model ------------------------------------------------------------------------------


def edit_chains(chains, *, without=(), free=(), fix=(), prior=()):
    """
    Return the chains with optics taken out and parameters freed, fixed or given a prior.

    The texts are those of the options, see ``_SHARED``; a number without unit is in the parameter's
    own. What does not fit, or is to be fixed and free at once, raises an error.
    """
    _check_fixed(fix, free, prior)
    # before the rest: what is out of the model has no parameters to edit
    known = {leaf.name for chain in chains for leaf in leaves(chain)}
    for name in without:
        # an effect of a diagnosis stands between two rotations into the frame of its optic
        around = [f"{name}_in", f"{name}_out"] if name.startswith("gap_") else []
        for each in (name, *(other for other in around if other in known)):
            chains = _changed(chains, each, partial(remove_optic, name=each))
    for name in free:
        for parameter in _parameters(chains, name):
            parameter.fixed = False
    for text in fix:
        name, _, value = text.partition("=")
        for parameter in _parameters(chains, name, f"--fix {text}" if value else ""):
            if value:
                _set(name, parameter, value)
            parameter.fixed = True
        # zero is the same in all units
        if parameter.unit and re.fullmatch(r"[-+.\deE\s]+", value) and float(value):
            warn(f"--fix {text}: no unit is given, {parameter.unit} is taken")
    for text in prior:
        name, _, value = text.partition("=")
        for parameter in _parameters(chains, name, f"--prior {text}"):
            parameter.prior = _normal(name, parameter, value)
            parameter.fixed = False
    return chains


def _changed(chains, optic, change):
    """Return the chains, those with an optic changed."""
    have = [any(leaf.name == optic for leaf in leaves(chain)) for chain in chains]
    if not any(have):
        # raises, with near matches
        find_optic(chains[0], optic)
    return [change(chain) if here else chain for chain, here in zip(chains, have, strict=True)]


def _check_fixed(fix, free, prior):
    """Refuse to hold what is named as free, or given a prior, as well."""
    named = [*(("free", text) for text in free), *(("prior", text) for text in prior)]
    for held, (option, text) in product((text.partition("=")[0] for text in fix), named):
        name = text.partition("=")[0]
        # an optic and one of its parameters: the parameter is the exception, if edited last
        if name == held or (option == "free" and name.startswith(f"{held}.")):
            raise ParameterError(
                f"--{option} {text} cannot be combined with --fix {held}: a parameter is either "
                "held or free"
            )


def _parameters(chains, name, label=""):
    """Return the parameters that ``optic.parameter`` or ``optic`` names, in all chains."""
    from astropolcal.measurement.parameters import parameters_named

    return [one for same in parameters_named(chains, name, label).values() for one in same]


def _normal(name, parameter, text):
    """Return the normal prior that MEAN+-STD describes, in the parameter's unit."""
    from astropolcal.measurement import Normal

    mean, separator, std = text.partition("+-")
    if not separator:
        raise ParameterError(f"prior {name}={text}: write it as MEAN+-STD, such as 0+-0.1deg")
    # a Normal wants a quantity where the parameter has a unit
    unit = 1 if parameter.unit is None else parameter.unit
    # "0+-0.1deg" gives its unit once
    bare = re.fullmatch(r"\s*[-+.\deE]+\s*", mean)
    own = re.sub(r"^\s*[-+.\d]+(?:[eE][-+]?\d+)?\s*", "", std)
    # both in the unit of the parameter, whatever was typed
    values = (_value(name, parameter, t) for t in ((mean + own if bare else mean), std))
    return Normal(*(value * unit for value in values))


def number_in(text, unit):
    """Return the number that a text with or without unit means, in a unit; or raise ValueError."""
    # a number, and perhaps a unit; no expression is evaluated
    match = re.fullmatch(r"\s*([-+.\d]+(?:[eE][-+]?\d+)?)\s*([A-Za-z%].*)?", text)
    number, own = match.groups() if match else ("", None)
    value = plain_number(number)
    return value if own is None else (value * u.Unit(own)).to_value(unit)


def _value(name, parameter, text):
    """Return the number that a text with or without unit means, in the parameter's unit."""
    unit = parameter.unit or u.dimensionless_unscaled
    try:
        return number_in(text, unit)
    except (ValueError, TypeError):
        raise ParameterError(
            f"{name}={text}: not a number, or its unit is not convertible to "
            f"{parameter.unit or 'a number'}; allowed are such as 1.5 or 1.5{parameter.unit or ''}"
        ) from None


def _set(name, parameter, text):
    value = _value(name, parameter, text)
    low, high = parameter.bounds
    low, high = -np.inf if low is None else low, np.inf if high is None else high
    if not (np.isfinite(value) and low <= value <= high):
        # bounds that were computed carry rounding errors
        low, high = (float(f"{bound:.7g}") for bound in (low, high))
        raise ParameterError(
            f"{name}={text}: allowed is {low} to {high} {parameter.unit or ''}".rstrip()
        )
    # the same at all wavelengths
    parameter.value = np.full(np.shape(parameter.value), value)


# ---- the summary with which a command ends: it fits a terminal of 80 columns and 24 lines ----


def ending(verdict, accuracy, determined, advice, written):
    """Return verdict, accuracy, what is determined, what to do next, and the files written."""
    told = {"Accuracy": accuracy, "Determined": determined, "Next": advice}
    words = [verdict, *(f"{name:<12}{text}" for name, text in told.items())]
    return [*(shortened(line) for line in words), *written]


def following(command, path):
    """Return the command to give next, its file as a shell takes it, in one line."""
    return one_line(f"astropolcal {command} {shlex.quote(str(path))}", None)


def written_lines(named, figures=0, folder=None):
    """Return a line for each file that was written; figures are counted."""
    names = [one_line(path, None) for path in named if path and str(path) != "-"]
    names += [f"{counted(figures, 'figure')} in {one_line(folder, None)}"] if figures else []
    return [f"Written:    {name}" for name in names]


def with_ending(body, ends, full):
    """Return a body and its summary in a terminal's lines; in full, the summary at both ends."""
    if full:
        return [*ends, "", *body, "", *ends]
    room, lines = HEIGHT - len(ends) - 1, "\n".join(body).split("\n")
    if len(lines) > room:
        lines[room - 1 :] = [f"and {len(lines) - room + 1} more lines (--full prints all)"]
    return [*lines, "", *ends] if body else ends
