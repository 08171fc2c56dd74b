"""A formula such as `~ sex + age` to the columns of a linear model: its terms, and contrasts between values.

Only names of columns and a few functions may stand in a formula, so it runs nothing but what it says. Columns and
coding are formulaic's; classes are coded by deviations (sum to zero), so that type III tests mean something.
"""

from __future__ import annotations

import ast
import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

import numpy as np

from shapespace.cohort.table import Table
from shapespace.errors import InputError, ShapespaceError
from shapespace.lazy import require_package
from shapespace.reprs import short_repr
from shapespace.types import FloatArray, read_only

INSTALL = "'shapespace[statistics]'"
FUNCTIONS: Mapping[str, str] = {
    "C": "classes, where a column holds their numbers",
    "log": "natural logarithm",
    "log10": "decimal logarithm",
    "sqrt": "square root",
    "center": "less its mean",
    "scale": "less its mean, in standard deviations",
    "poly": "orthogonal polynomial, poly(age, 2)",
    "bs": "B-spline, bs(age, df=4)",
    "cr": "natural cubic spline, cr(age, df=2)",
}
"""What a formula may call, and what it is."""

# characters, stars, names and constants that bound the time a formula takes to expand
_LONGEST, _MOST_STARS, _MOST_NAMES, _LARGEST_CONSTANT = 1000, 5, 64, 20
_MOST_CELLS = 100_000  # combinations of levels, which are enumerated
_MOST_COLUMNS = 5000
"""Limit before repeated or implied columns are removed; more take seconds to expand, and need as many shapes."""
_DEEPEST = 30
"""Limit of nested brackets."""
_SPLINE = 4
"""Number of columns of a polynomial or spline if the formula has none; 3 for cubic ones."""
_TOKEN = re.compile(r"\s*(`[^`]*`|[\w.]+|\*\*|[-+*:/^()])")
_PLAIN = re.compile(r"""[\w\s+\-*:/^().,~="']*""")
_QUOTED = re.compile(r"`([^`]*)`")
_POWER = re.compile(r"\*\*|\^")
_ALLOWED = f"columns and {', '.join(FUNCTIONS)} are all that may stand there."
_CONTEXT = {"sqrt": np.sqrt}
Coding: TypeAlias = Literal["deviation", "treatment"]
"""Coding of classes: deviations from their mean, or differences from the first class."""
_CONTRASTS: Mapping[Coding, str] = {"deviation": "contr.sum", "treatment": "contr.treatment"}


@dataclass(frozen=True, kw_only=True)
class Variable:
    """A column that a formula names, as numbers or as classes.

    Args:
        name: of the column; in C() where its numbers are taken for classes.
        column: its name inside.
        levels: classes in order; none of numbers.
        groups: classes whose sizes and dispersion count: the levels, or both values of numbers that have only two.
        low: 5th percentile of numbers; the smaller of two values.
        high: 95th percentile; the larger of two values.
        middle: their mean.
    """

    name: str
    column: str
    levels: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    low: float = 0.0
    high: float = 0.0
    middle: float = 0.0

    def describe(self, value: str | float) -> str:
        """Return a value in words, such as `sex female` or `age 61`."""
        return f"{self.name} {value}" if isinstance(value, str) else f"{self.name} {value:.4g}"


@dataclass(frozen=True)
class Term:
    """A term of a formula.

    Args:
        label: as it is called.
        factors: what is multiplied in it, as written.
        variables: of them, by their names inside.
        columns: of the design.
    """

    label: str
    factors: frozenset[str]
    variables: frozenset[str]
    columns: tuple[int, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class Design:
    """The columns of a linear model beside the intercept.

    Args:
        formula: as it was given.
        matrix: (N, p).
        terms: of it, those of fewer variables first.
        variables: that it names.
        values: N of each variable, by its name inside.
        factors: the variable, by its name inside, of each factor of the terms, in the order of the formula.
    """

    formula: str
    matrix: FloatArray
    terms: tuple[Term, ...]
    variables: tuple[Variable, ...]
    values: Mapping[str, Sequence[str | float]]
    factors: Mapping[str, str]
    _codes: Mapping[str, str] = field(repr=False)
    _spec: Any = field(repr=False)
    _skipped: int = field(default=1, repr=False)
    _parts: dict[tuple[frozenset[str], ...], Design] = field(
        default_factory=lambda: dict[tuple[frozenset[str], ...], "Design"](), repr=False
    )

    __repr__ = short_repr

    def rows(self, values: Mapping[str, Sequence[str | float]]) -> FloatArray:
        """Return the (n, p) columns where each variable, by its name inside, has these n values."""
        made = self._spec.get_model_matrix(self._frame(values), context=_CONTEXT)
        return np.asarray(made, dtype=np.float64)[:, self._skipped :]

    def part(self, products: Sequence[frozenset[str]]) -> Design:
        """Return the columns of other products of the same factors, for the same rows.

        Args:
            products: factors of each, as in `Term.factors`; the empty product is the constant and comes first.
        """
        key = tuple(products)
        if key in self._parts:
            return self._parts[key]
        formulaic = require_package("formulaic", "A formula", INSTALL)
        ordered = [[factor for factor in self.factors if factor in product] for product in products]
        written = [":".join(self._codes[factor] for factor in product) or "1" for product in ordered]
        with np.errstate(all="ignore"):
            made = formulaic.Formula(written, _ordering="none").get_model_matrix(
                self._frame(self.values), context=_CONTEXT, na_action="ignore"
            )
        spec = made.model_spec
        slices = [tuple(int(column) for column in indices) for indices in spec.term_indices.values()]
        terms = tuple(
            Term(":".join(product) or "1", frozenset(product), frozenset(self.factors[one] for one in product), own)
            for product, own in zip(ordered, slices, strict=True)
        )
        matrix = read_only(np.asarray(made, dtype=np.float64))
        made = replace(self, matrix=matrix, terms=terms, _spec=spec, _skipped=0, _parts={})
        self._parts[key] = made
        return made

    def _frame(self, values: Mapping[str, Sequence[str | float]]) -> Any:
        pandas = require_package("pandas", "A formula", INSTALL)
        frame: dict[str, Any] = {}
        for one in self.variables:
            own = list(values[one.column])
            frame[one.column] = pandas.Categorical(own, categories=one.levels) if one.levels else own
        return pandas.DataFrame(frame)

    def groups_of(self, one: Variable) -> list[str]:
        """Return the group of each row by a variable that has groups."""
        values = self.values[one.column]
        return [str(value) for value in values] if one.levels else [_group(float(value)) for value in values]

    def average(self, fixed: Mapping[str, str | float], averaged: frozenset[str] | None = None) -> FloatArray:
        """Return the (p,) columns, averaged over the classes of variables in the terms, with numbers at their mean.

        Args:
            fixed: values of variables that are not averaged, by their names inside.
            averaged: variables whose classes are averaged; None for those of all terms.
        """
        used = {name for term in self.terms for name in term.variables} if averaged is None else averaged
        choices: list[Sequence[str | float]] = []
        for one in self.variables:
            own = one.levels if one.column in used else one.levels[:1]
            choices.append((fixed[one.column],) if one.column in fixed else own or (one.middle,))
        cells = _cells(choices, self.formula)
        return read_only(
            self.rows({one.column: [cell[k] for cell in cells] for k, one in enumerate(self.variables)}).mean(axis=0)
        )

    def contrast(
        self, column: str, low: str | float, high: str | float, fixed: Mapping[str, str | float] | None = None
    ) -> FloatArray:
        """Return what `high` has more than `low` in each of the p columns, on an average of the other variables.

        Classes of the others count alike, numbers stand at their mean; only others that share a term matter.

        Args:
            column: of the variable, by its name inside.
            low: value.
            high: value.
            fixed: values of other variables, by their names inside.
        """
        interacting = frozenset(name for term in self.terms if column in term.variables for name in term.variables)
        at_low, at_high = (self.average({**(fixed or {}), column: value}, interacting) for value in (low, high))
        return read_only(at_high - at_low)


def _cells(choices: Sequence[Sequence[str | float]], formula: str) -> list[tuple[str | float, ...]]:
    if np.prod([float(len(choice)) for choice in choices]) > _MOST_CELLS:
        raise InputError(f"The classes in {formula!r} make too many combinations; leave out interactions.")
    return list(itertools.product(*choices))


def columns_of(formula: str, table: Table) -> dict[str, set[str]]:
    """Return the columns of the table that a formula names, and the functions of each; "" for the column itself.

    Raises:
        InputError: it cannot be read, or names something else.
        ShapespaceError: the extra `statistics` is not installed.
    """
    calls: dict[str, set[str]] = {}
    for factor in itertools.chain.from_iterable(_parsed(formula, table)):
        calls.setdefault(factor.name, set()).add(factor.call)
    return calls


def quoted(column: str) -> str:
    """Return the name of a column as it is written in a formula, in backticks where it needs them."""
    return column if column.isidentifier() else f"`{column}`"


def random_effects_of(random: str, table: Table) -> tuple[tuple[frozenset[str], ...], str]:
    """Return the effects that vary by subject, as products of factors, and the column that names the subject.

    Args:
        random: random terms such as `1 + time | subject`; they must contain the 1, the mean of each subject.
        table: with the columns that the terms name.

    Raises:
        InputError: it cannot be read, leaves out the 1, or names something that is no column.
        ShapespaceError: the extra `statistics` is not installed.
    """
    inner = random.strip()
    if inner.startswith("(") and inner.endswith(")"):
        # lme4 writes them in brackets.
        inner = inner[1:-1]
    effects, bar, column = (part.strip() for part in inner.partition("|"))
    column = column.strip("`")
    if not bar or not effects or not column:
        raise InputError(f"The random terms {random[:80]!r} cannot be read; write them as '1 + time | subject'.")
    if column not in table.columns:
        raise InputError(
            f"The random terms {random[:80]!r} name {column[:60]!r}, which is no column; there is "
            f"{', '.join(table.columns)}."
        )
    if effects == "1":
        return (), column
    return tuple(frozenset(factor.text for factor in term) for term in _parsed(effects, table)), column


def design_of(formula: str, table: Table, coding: Coding = "deviation") -> Design:
    """Return the columns of a linear model of the rows of a table, in which nothing that is named is missing.

    Args:
        formula: of the model.
        table: with the columns that it names.
        coding: of classes.

    Raises:
        InputError: the formula cannot be read, names something that is no column or calls something that is not in
            `FUNCTIONS`; a column is the same for all, holds text where numbers should be, or gives no finite number.
        ShapespaceError: the extra `statistics` is not installed.
    """
    parsed = _parsed(formula, table)
    pandas = require_package("pandas", "A formula", INSTALL)
    formulaic = require_package("formulaic", "A formula", INSTALL)
    inside: dict[tuple[str, bool], Variable] = {}
    frame: dict[str, Any] = {}
    own_values: dict[str, Sequence[str | float]] = {}
    for factor in itertools.chain.from_iterable(parsed):
        classes = factor.holds_classes(table)
        if (factor.name, classes) not in inside:
            variable, values = _variable(table, factor.name, f"v{len(inside)}", classes=classes)
            inside[factor.name, classes] = variable
            own_values[variable.column] = values
            frame[variable.column] = (
                pandas.Categorical(values, categories=variable.levels) if classes else np.asarray(values)
            )
    written, labels = ["1"], list[str]()
    variable_of, codes = dict[str, str](), dict[str, str]()
    factors, members = list[frozenset[str]](), list[frozenset[str]]()
    for term in parsed:
        own = [inside[factor.name, factor.holds_classes(table)] for factor in term]
        for factor, one in zip(term, own, strict=True):
            variable_of[factor.text] = one.column
            codes[factor.text] = factor.written(one.column, coding, classes=bool(one.levels))
        written.append(":".join(codes[factor.text] for factor in term))
        labels.append(":".join(factor.text for factor in term))
        factors.append(frozenset(factor.text for factor in term))
        members.append(frozenset(one.column for one in own))
    try:
        with np.errstate(all="ignore"):
            made = formulaic.Formula(written, _ordering="none").get_model_matrix(
                pandas.DataFrame(frame), context=_CONTEXT, na_action="ignore"
            )
    # formulaic hands on whatever the functions of a formula raise.
    except Exception as error:
        raise InputError(f"The formula {formula!r} cannot be worked out ({_first(error)}); correct it.") from error
    matrix = np.asarray(made, dtype=np.float64)
    spec = made.model_spec
    slices = [tuple(int(index) - 1 for index in indices) for indices in spec.term_indices.values()][1:]
    terms = tuple(Term(*parts) for parts in zip(labels, factors, members, slices, strict=True))
    for term in terms:
        if not np.isfinite(matrix[:, [index + 1 for index in term.columns]]).all():
            raise InputError(f"{table.where}: {term.label} is not finite in all rows, as a logarithm of 0 would be.")
    return Design(
        formula=formula,
        matrix=read_only(matrix[:, 1:]),
        terms=terms,
        variables=tuple(inside.values()),
        values=own_values,
        factors=variable_of,
        _codes=codes,
        _spec=spec,
    )


@dataclass(frozen=True)
class _Factor:
    """A piece of a term: a column, or what a function makes of it.

    Args:
        text: as it was written.
        name: of the column.
        call: the function; empty for none.
        tree: the call; None for none.
    """

    text: str
    name: str
    call: str = ""
    tree: ast.expr | None = None

    def holds_classes(self, table: Table) -> bool:
        """Return whether it is classes, not numbers.

        Raises:
            InputError: a function needs numbers and the column holds text.
        """
        text = table.kind(self.name) == "text"
        if text and self.call not in ("", "C"):
            raise InputError(
                f"{table.where}: {self.call}() in the formula needs numbers, and {self.name!r} holds text."
            )
        return text or self.call == "C"

    def written(self, column: str, coding: Coding, *, classes: bool) -> str:
        """Return it with the column's name inside, which can be no code."""
        if classes:
            return f"C({column}, {_CONTRASTS[coding]})"
        return column if self.tree is None else ast.unparse(_renamed(self.tree, column))


def _renamed(tree: ast.expr, column: str) -> ast.expr:
    """Return a checked call with `column` for its innermost first argument."""
    if isinstance(tree, ast.Call):
        # Without the constraint the columns of cr() contain the constant.
        centred = [ast.keyword("constraints", ast.Constant("center"))] if ast.unparse(tree.func) == "cr" else []
        return ast.Call(tree.func, [_renamed(tree.args[0], column), *tree.args[1:]], [*tree.keywords, *centred])
    return ast.Name(column)


def _parsed(formula: str, table: Table) -> list[list[_Factor]]:
    formulaic = require_package("formulaic", "A formula", INSTALL)
    where = f"The formula {formula[:80]!r}"
    right = formula.strip().removeprefix("~")
    plain = _QUOTED.sub("x", right)
    stars = len(re.findall(r"\*", _POWER.sub("", plain)))
    powers = len(_POWER.findall(plain))
    # Longer names first, as they contain the shorter ones.
    odd = sorted((name for name in table.columns if not re.fullmatch(r"[\w.]+", name)), key=len, reverse=True)
    unquoted = next((name for name in odd if name in _QUOTED.sub("", right)), None)
    advice = "write one such as '~ sex + age'" if unquoted is None else f"write {quoted(unquoted)} with its backticks"
    if "~" in plain:
        raise InputError(
            f"{where} has something before ~ or a second one; shape is what is explained, so write '~ sex'."
        )
    if len(formula) > _LONGEST or stars > _MOST_STARS or powers > 1 or len(re.findall(r"\w+", plain)) > _MOST_NAMES:
        raise InputError(f"{where} is too long; write a shorter one.")
    if not _PLAIN.fullmatch(plain) or re.search(r"(\*\*|\^)(?!\s*[23]\b)", plain):
        raise InputError(
            f"{where} holds something other than columns, + - * : / ^ and the functions of a formula; {advice}."
        )
    columns = _Bound(right, table, where, advice).columns()
    if columns > _MOST_COLUMNS:
        raise InputError(
            f"{where} makes up to {columns if columns < 10**9 else 'billions of'} columns, and {_MOST_COLUMNS} are "
            "the limit; leave out interactions or classes."
        )
    try:
        terms = list(formulaic.Formula("~ " + right, _ordering="degree"))
        keeps_mean = any(str(term) == "1" for term in terms)
        drawn = [[_factor(f, table, where) for f in term.factors] for term in terms if str(term) != "1"]
    except ShapespaceError:
        raise
    # The parser raises what it likes on what it cannot read.
    except Exception as error:
        raise InputError(f"{where} cannot be read ({_first(error)}); {advice}.") from error
    if not keeps_mean:
        raise InputError(f"{where} leaves out the mean shape, without which effects mean nothing; drop the 0 or - 1.")
    if not drawn:
        raise InputError(f"{where} names no column; write one such as '~ sex + age'.")
    return drawn


@dataclass(frozen=True)
class _Size:
    """Upper bounds of the number of columns of a part of a formula, and of the product of all its factors."""

    columns: int
    product: int


class _Bound:
    """Upper bound of the number of columns of a formula, without expanding it; operators are those of R."""

    def __init__(self, text: str, table: Table, where: str, advice: str) -> None:
        self.table, self.where, self.advice = table, where, advice
        self.tokens: list[str] = []
        position = 0
        while text[position:].strip():
            match = _TOKEN.match(text, position)
            # Only arguments of functions have other characters, and these are read by name and numbers alone.
            self.tokens.append(match.group(1) if match else text[position])
            position = match.end() if match else position + 1
        self.position = self.depth = 0

    def columns(self) -> int:
        """Return an upper bound of the columns.

        Raises:
            InputError: brackets or operators do not match.
        """
        if not self.tokens:
            return 0
        size = self._sum()
        if self.position < len(self.tokens):
            raise self._unreadable()
        return size.columns

    def _unreadable(self) -> InputError:
        near = self.tokens[min(self.position, len(self.tokens) - 1)]
        return InputError(f"{self.where} cannot be read near {near[:20]!r}; {self.advice}.")

    def _next(self, *wanted: str) -> str:
        """Return the next token and go past it if it is one of those wanted, else an empty text."""
        token = self.tokens[self.position] if self.position < len(self.tokens) else ""
        if token not in wanted:
            return ""
        self.position += 1
        return token

    def _sum(self) -> _Size:
        self._next("+", "-")
        size = self._product()
        while self._next("+", "-"):
            other = self._product()
            size = _Size(size.columns + other.columns, size.product * other.product)
        return size

    def _product(self) -> _Size:
        size = self._interaction()
        while operator := self._next("*", "/"):
            other = self._interaction()
            # a / b is a + a:b, with all factors of a in the product.
            own = size.columns if operator == "*" else size.product
            columns = size.columns + own * other.columns + (other.columns if operator == "*" else 0)
            size = _Size(columns, size.product * other.product)
        return size

    def _interaction(self) -> _Size:
        size = self._power()
        while self._next(":"):
            other = self._power()
            size = _Size(size.columns * other.columns, size.product * other.product)
        return size

    def _power(self) -> _Size:
        size = self._atom()
        while self._next("**", "^"):
            exponent = self._next("2", "3")
            if not exponent:
                raise self._unreadable()
            # Products of different terms, in any order.
            each = range(1, int(exponent) + 1)
            size = _Size(sum(size.columns**k // math.factorial(k) + 1 for k in each), size.product)
        return size

    def _atom(self) -> _Size:
        if self._next("("):
            self.depth += 1
            if self.depth > _DEEPEST:
                raise self._unreadable()
            size = self._sum()
            self.depth -= 1
            if not self._next(")"):
                raise self._unreadable()
            return size
        token = self.tokens[self.position] if self.position < len(self.tokens) else ""
        if not re.match(r"[\w.`]", token):
            raise self._unreadable()
        self.position += 1
        if not self._next("("):
            return self._size_of(token.strip("`"))
        inside, depth = list[str](), 1
        while depth and self.position < len(self.tokens):
            inside.append(self.tokens[self.position])
            depth += {"(": 1, ")": -1}.get(inside[-1], 0)
            self.position += 1
        if depth:
            raise self._unreadable()
        if token in ("poly", "bs", "cr"):
            columns = max([_SPLINE, *(int(one) for one in inside if one.isdecimal() and len(one) < 3)])
            return _Size(columns, columns)
        return max(
            (self._size_of(one.strip("`"), classes=token == "C") for one in inside), key=lambda size: size.columns
        )

    def _size_of(self, name: str, *, classes: bool = False) -> _Size:
        if name not in self.table.columns or not (classes or self.table.kind(name) == "text"):
            return _Size(1, 1)
        levels = len(set(self.table.texts(name)))
        return _Size(levels, levels)


def _factor(factor: Any, table: Table, where: str) -> _Factor:
    text, kind = str(factor.expr), factor.eval_method.value
    if kind == "lookup":
        return _Factor(text, _known(text, table, where))
    quoted_names: dict[str, str] = {}

    plain = _QUOTED.sub(lambda match: quoted_names.setdefault(match[1], f"quoted_{len(quoted_names)}_"), text)
    tree = ast.parse(plain, mode="eval").body if kind == "python" else None
    if tree is None or not isinstance(tree, ast.Call) or not isinstance(tree.func, ast.Name):
        raise InputError(f"{where} holds {text[:60]!r}; {_ALLOWED}")
    if tree.func.id == "C" and not (len(tree.args) == 1 and isinstance(tree.args[0], ast.Name) and not tree.keywords):
        raise InputError(f"{where}: {text[:60]!r} must take one column and nothing else.")
    column = _column(tree, where)
    name = next((name for name, own in quoted_names.items() if own == column), column)
    return _Factor(_QUOTED.sub(r"\1", text), _known(name, table, where), tree.func.id, tree)


def _column(tree: ast.expr, where: str) -> str:
    """Return the column in calls of `FUNCTIONS`, whose first argument is a column or a call, and others numbers."""
    if isinstance(tree, ast.Name):
        return tree.id
    function = tree.func.id if isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name) else ""
    if not isinstance(tree, ast.Call) or function not in FUNCTIONS or not tree.args:
        raise InputError(f"{where} holds {ast.unparse(tree)[:60]!r}; {_ALLOWED}")
    for value in (*tree.args[1:], *(keyword.value for keyword in tree.keywords)):
        constant = value.value if isinstance(value, ast.Constant) else None
        if not isinstance(constant, int | float) or not 0 <= constant <= _LARGEST_CONSTANT:
            raise InputError(f"{where} gives {function}() something other than a number up to {_LARGEST_CONSTANT}.")
    return _column(tree.args[0], where)


def _known(name: str, table: Table, where: str) -> str:
    if name not in table.columns:
        raise InputError(f"{where} names {name[:60]!r}, which is no column; there is {', '.join(table.columns)}.")
    return name


def _variable(table: Table, name: str, column: str, *, classes: bool) -> tuple[Variable, Sequence[str | float]]:
    """Return a column as a variable and its values, of which there are two or more."""
    if not classes:
        numbers = table.numbers(name)
        if np.ptp(numbers) == 0:
            raise InputError(f"{table.where}: {name!r} is {numbers[0]:g} for all {len(table)} shapes; leave it out.")
        low, high = (float(value) for value in np.percentile(numbers, [5, 95]))
        two = len(set(numbers.tolist())) == 2
        if two or low == high:
            low, high = float(numbers.min()), float(numbers.max())
        groups = (_group(low), _group(high)) if two else ()
        return Variable(
            name=name, column=column, levels=(), groups=groups, low=low, high=high, middle=float(numbers.mean())
        ), [float(v) for v in numbers]
    numeric = table.kind(name) == "number"
    cells = [f"{float(cell):g}" if numeric else cell for cell in table.texts(name)]
    levels = tuple(sorted(set(cells), key=float) if numeric else sorted(set(cells)))
    if len(levels) == 1:
        raise InputError(
            f"{table.where}: {name!r} is {levels[0][:40]!r} for all {len(table)} shapes; a comparison needs two groups."
        )
    return Variable(name=f"C({name})" if numeric else name, column=column, levels=levels, groups=levels), cells


def _group(value: float) -> str:
    return f"{value:.15g}"


def _first(error: Exception) -> str:
    text = re.sub(r"\x1b\[[0-9;]*m|[⧛⧚]", "", str(error)).strip()
    return (text.splitlines() or [type(error).__name__])[0][:120].rstrip(".")
