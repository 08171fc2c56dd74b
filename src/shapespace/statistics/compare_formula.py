"""Columns of a linear model from a formula such as `~ sex + age`: its terms, and contrasts between values.

A formula may contain only names of columns and a few functions, so that it cannot run other code. Columns and coding
are those of formulaic; classes are coded by deviations (sum to zero), so that type III tests are meaningful.
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
    "C": "classes, if the values of a column are their numbers",
    "log": "natural logarithm",
    "log10": "decimal logarithm",
    "sqrt": "square root",
    "center": "less its mean",
    "scale": "less its mean, in standard deviations",
    "poly": "orthogonal polynomial, poly(age, 2)",
    "bs": "B-spline, bs(age, df=4)",
    "cr": "natural cubic spline, cr(age, df=2)",
}
"""Functions that a formula may call, with their description."""

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
_ALLOWED = f"a formula may contain only columns and {', '.join(FUNCTIONS)}."
_CONTEXT = {"sqrt": np.sqrt}
Coding: TypeAlias = Literal["deviation", "treatment"]
"""Coding of classes: deviations from their mean, or differences from the first class."""
_CONTRASTS: Mapping[Coding, str] = {"deviation": "contr.sum", "treatment": "contr.treatment"}


@dataclass(frozen=True, kw_only=True)
class Variable:
    """A column that a formula names, as numbers or as classes.

    Args:
        name: name of the column; in C() if its numbers denote classes.
        column: internal name of the column.
        levels: classes in order; empty for numbers.
        groups: classes whose sizes and dispersions are checked: the levels, or the two values of a column of numbers
            with only two; empty for other numbers.
        low: 5th percentile of numbers, or the smaller value if there are only two.
        high: 95th percentile of numbers, or the larger value if there are only two.
        middle: mean of numbers.
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
        label: name of the term.
        factors: factors that the term multiplies, as written.
        variables: internal names of the variables in these factors.
        columns: columns of the design that belong to the term.
    """

    label: str
    factors: frozenset[str]
    variables: frozenset[str]
    columns: tuple[int, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class Design:
    """The columns of a linear model, except the intercept.

    Args:
        formula: formula as passed.
        matrix: (N, p) columns of the model.
        terms: terms of the formula, those of fewer variables first.
        variables: variables that the formula names.
        values: internal name of each variable -> its N values.
        factors: factor of the terms -> internal name of its variable, in the order of the formula.
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
        """Return the (n, p) columns for n given values of each variable, by its internal name."""
        made = self._spec.get_model_matrix(self._frame(values), context=_CONTEXT)
        return np.asarray(made, dtype=np.float64)[:, self._skipped :]

    def part(self, products: Sequence[frozenset[str]]) -> Design:
        """Return the columns of other products of the same factors, for the same rows.

        Args:
            products: factors of each product, as in `Term.factors`; the empty product is the constant and comes first.
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
            Term(
                ":".join(product) or "1", frozenset(product), frozenset(self.factors[factor] for factor in product), own
            )
            for product, own in zip(ordered, slices, strict=True)
        )
        matrix = read_only(np.asarray(made, dtype=np.float64))
        made = replace(self, matrix=matrix, terms=terms, _spec=spec, _skipped=0, _parts={})
        self._parts[key] = made
        return made

    def _frame(self, values: Mapping[str, Sequence[str | float]]) -> Any:
        pandas = require_package("pandas", "A formula", INSTALL)
        frame: dict[str, Any] = {}
        for variable in self.variables:
            own = list(values[variable.column])
            frame[variable.column] = pandas.Categorical(own, categories=variable.levels) if variable.levels else own
        return pandas.DataFrame(frame)

    def groups_of(self, variable: Variable) -> list[str]:
        """Return the group of each row by a variable that has groups."""
        values = self.values[variable.column]
        return [str(value) for value in values] if variable.levels else [_group_label(float(value)) for value in values]

    def average(self, fixed: Mapping[str, str | float], averaged: frozenset[str] | None = None) -> FloatArray:
        """Return the (p,) columns, averaged over the classes of variables in the terms, with numbers at their mean.

        Args:
            fixed: values of variables that are not averaged, by their internal names.
            averaged: variables whose classes are averaged; None for those of all terms.
        """
        used = {name for term in self.terms for name in term.variables} if averaged is None else averaged
        choices: list[Sequence[str | float]] = []
        for variable in self.variables:
            own = variable.levels if variable.column in used else variable.levels[:1]
            choices.append((fixed[variable.column],) if variable.column in fixed else own or (variable.middle,))
        cells = _cells(choices, self.formula)
        return read_only(
            self.rows({variable.column: [cell[k] for cell in cells] for k, variable in enumerate(self.variables)}).mean(
                axis=0
            )
        )

    def contrast(
        self, column: str, low: str | float, high: str | float, fixed: Mapping[str, str | float] | None = None
    ) -> FloatArray:
        """Return the difference of each of the p columns between `high` and `low`, averaged over the other variables.

        All classes of the others have the same weight, numbers are at their mean; only others that share a term matter.

        Args:
            column: internal name of the variable.
            low: value from which it changes.
            high: value to which it changes.
            fixed: values of other variables, by their internal names.
        """
        interacting = frozenset(name for term in self.terms if column in term.variables for name in term.variables)
        at_low, at_high = (self.average({**(fixed or {}), column: value}, interacting) for value in (low, high))
        return read_only(at_high - at_low)


def _cells(choices: Sequence[Sequence[str | float]], formula: str) -> list[tuple[str | float, ...]]:
    if np.prod([float(len(choice)) for choice in choices]) > _MOST_CELLS:
        raise InputError(f"The classes in {formula!r} make too many combinations; remove interactions.")
    return list(itertools.product(*choices))


def columns_of(formula: str, table: Table) -> dict[str, set[str]]:
    """Return the columns of the table that a formula names, with the functions of each; "" for the column itself.

    Raises:
        InputError: the formula cannot be read, or names something else.
        ShapespaceError: the extra `statistics` is not installed.
    """
    calls: dict[str, set[str]] = {}
    for factor in itertools.chain.from_iterable(_parse_terms(formula, table)):
        calls.setdefault(factor.name, set()).add(factor.call)
    return calls


def quoted(column: str) -> str:
    """Return the name of a column as it is written in a formula, in backticks if it needs them."""
    return column if column.isidentifier() else f"`{column}`"


def random_effects_of(random: str, table: Table) -> tuple[tuple[frozenset[str], ...], str]:
    """Return the effects that vary by subject, as products of factors, and the column that names the subject.

    Args:
        random: random terms such as `1 + time | subject`; they must contain the 1, the mean of each subject.
        table: table with the columns that the terms name.

    Raises:
        InputError: the random terms cannot be read, omit the 1, or name something that is no column.
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
    return tuple(frozenset(factor.text for factor in term) for term in _parse_terms(effects, table)), column


def design_of(formula: str, table: Table, coding: Coding = "deviation") -> Design:
    """Return the columns of a linear model of the rows of a table, whose named columns have no missing values.

    Args:
        formula: formula of the model.
        table: table with the columns that the formula names.
        coding: coding of classes.

    Raises:
        InputError: the formula cannot be read, names something that is no column or calls something that is not in
            `FUNCTIONS`; a column is constant, contains text where numbers are needed, or yields no finite number.
        ShapespaceError: the extra `statistics` is not installed.
    """
    parsed = _parse_terms(formula, table)
    pandas = require_package("pandas", "A formula", INSTALL)
    formulaic = require_package("formulaic", "A formula", INSTALL)
    inside: dict[tuple[str, bool], Variable] = {}
    frame: dict[str, Any] = {}
    own_values: dict[str, Sequence[str | float]] = {}
    for factor in itertools.chain.from_iterable(parsed):
        classes = factor.holds_classes(table)
        if (factor.name, classes) not in inside:
            variable, values = _make_variable(table, factor.name, f"v{len(inside)}", classes=classes)
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
        for factor, variable in zip(term, own, strict=True):
            variable_of[factor.text] = variable.column
            codes[factor.text] = factor.written(variable.column, coding, classes=bool(variable.levels))
        written.append(":".join(codes[factor.text] for factor in term))
        labels.append(":".join(factor.text for factor in term))
        factors.append(frozenset(factor.text for factor in term))
        members.append(frozenset(variable.column for variable in own))
    try:
        with np.errstate(all="ignore"):
            made = formulaic.Formula(written, _ordering="none").get_model_matrix(
                pandas.DataFrame(frame), context=_CONTEXT, na_action="ignore"
            )
    # formulaic passes on any exception of the functions in a formula.
    except Exception as error:
        raise InputError(f"The formula {formula!r} cannot be worked out ({_first_line(error)}); correct it.") from error
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
    """A factor of a term: a column, or a function of a column.

    Args:
        text: factor as written.
        name: name of the column.
        call: name of the function; empty if there is none.
        tree: parsed call of the function; None if there is none.
    """

    text: str
    name: str
    call: str = ""
    tree: ast.expr | None = None

    def holds_classes(self, table: Table) -> bool:
        """Return whether the factor is classes, not numbers.

        Raises:
            InputError: a function needs numbers and the column contains text.
        """
        text = table.kind(self.name) == "text"
        if text and self.call not in ("", "C"):
            raise InputError(
                f"{table.where}: {self.call}() in the formula needs numbers, and {self.name!r} contains text."
            )
        return text or self.call == "C"

    def written(self, column: str, coding: Coding, *, classes: bool) -> str:
        """Return the factor with the column's internal name, which cannot be code."""
        if classes:
            return f"C({column}, {_CONTRASTS[coding]})"
        return column if self.tree is None else ast.unparse(_rename_column(self.tree, column))


def _rename_column(tree: ast.expr, column: str) -> ast.expr:
    """Return a nested call with `column` as the first argument of its innermost call; each `cr` gets centred
    constraints.
    """
    if isinstance(tree, ast.Call):
        # Without the constraint the columns of cr() contain the constant.
        centred = [ast.keyword("constraints", ast.Constant("center"))] if ast.unparse(tree.func) == "cr" else []
        return ast.Call(tree.func, [_rename_column(tree.args[0], column), *tree.args[1:]], [*tree.keywords, *centred])
    return ast.Name(column)


def _parse_terms(formula: str, table: Table) -> list[list[_Factor]]:
    formulaic = require_package("formulaic", "A formula", INSTALL)
    where = f"The formula {formula[:80]!r}"
    right = formula.strip().removeprefix("~")
    plain = _QUOTED.sub("x", right)
    stars = len(re.findall(r"\*", _POWER.sub("", plain)))
    powers = len(_POWER.findall(plain))
    # Longer names first, as they contain the shorter ones.
    odd = sorted((name for name in table.columns if not re.fullmatch(r"[\w.]+", name)), key=len, reverse=True)
    unquoted = next((name for name in odd if name in _QUOTED.sub("", right)), None)
    advice = (
        "write a formula such as '~ sex + age'" if unquoted is None else f"write {quoted(unquoted)} with its backticks"
    )
    if "~" in plain:
        raise InputError(f"{where} has something before ~, or a second ~; shape is the response, so write '~ sex'.")
    if len(formula) > _LONGEST or stars > _MOST_STARS or powers > 1 or len(re.findall(r"\w+", plain)) > _MOST_NAMES:
        raise InputError(f"{where} is too long; write a shorter formula.")
    if not _PLAIN.fullmatch(plain) or re.search(r"(\*\*|\^)(?!\s*[23]\b)", plain):
        raise InputError(
            f"{where} contains something other than columns, + - * : / ^ and the functions of a formula; {advice}."
        )
    columns = _Bound(right, table, where, advice).columns()
    if columns > _MOST_COLUMNS:
        raise InputError(
            f"{where} makes up to {columns if columns < 10**9 else 'billions of'} columns, and {_MOST_COLUMNS} are "
            "the limit; remove interactions or classes."
        )
    try:
        terms = list(formulaic.Formula("~ " + right, _ordering="degree"))
        keeps_mean = any(str(term) == "1" for term in terms)
        drawn = [[_parse_factor(f, table, where) for f in term.factors] for term in terms if str(term) != "1"]
    except ShapespaceError:
        raise
    # The parser may raise any exception for text that it cannot read.
    except Exception as error:
        raise InputError(f"{where} cannot be read ({_first_line(error)}); {advice}.") from error
    if not keeps_mean:
        raise InputError(f"{where} omits the mean shape, without which effects mean nothing; remove the 0 or - 1.")
    if not drawn:
        raise InputError(f"{where} names no column; write a formula such as '~ sex + age'.")
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
        """Return the next token and go past it if it is one of `wanted`, else return an empty text."""
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
            columns = max([_SPLINE, *(int(part) for part in inside if part.isdecimal() and len(part) < 3)])
            return _Size(columns, columns)
        return max(
            (self._size_of(part.strip("`"), classes=token == "C") for part in inside), key=lambda size: size.columns
        )

    def _size_of(self, name: str, *, classes: bool = False) -> _Size:
        if name not in self.table.columns or not (classes or self.table.kind(name) == "text"):
            return _Size(1, 1)
        levels = len(set(self.table.texts(name)))
        return _Size(levels, levels)


def _parse_factor(factor: Any, table: Table, where: str) -> _Factor:
    text, kind = str(factor.expr), factor.eval_method.value
    if kind == "lookup":
        return _Factor(text, _check_column(text, table, where))
    quoted_names: dict[str, str] = {}

    plain = _QUOTED.sub(lambda match: quoted_names.setdefault(match[1], f"quoted_{len(quoted_names)}_"), text)
    tree = ast.parse(plain, mode="eval").body if kind == "python" else None
    if tree is None or not isinstance(tree, ast.Call) or not isinstance(tree.func, ast.Name):
        raise InputError(f"{where} contains {text[:60]!r}; {_ALLOWED}")
    if tree.func.id == "C" and not (len(tree.args) == 1 and isinstance(tree.args[0], ast.Name) and not tree.keywords):
        raise InputError(f"{where}: {text[:60]!r} must take one column and nothing else.")
    column = _innermost_column(tree, where)
    name = next((name for name, own in quoted_names.items() if own == column), column)
    return _Factor(_QUOTED.sub(r"\1", text), _check_column(name, table, where), tree.func.id, tree)


def _innermost_column(tree: ast.expr, where: str) -> str:
    """Return the column in nested calls of `FUNCTIONS`; arguments other than the first must be numbers."""
    if isinstance(tree, ast.Name):
        return tree.id
    function = tree.func.id if isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name) else ""
    if not isinstance(tree, ast.Call) or function not in FUNCTIONS or not tree.args:
        raise InputError(f"{where} contains {ast.unparse(tree)[:60]!r}; {_ALLOWED}")
    for value in (*tree.args[1:], *(keyword.value for keyword in tree.keywords)):
        constant = value.value if isinstance(value, ast.Constant) else None
        if not isinstance(constant, int | float) or not 0 <= constant <= _LARGEST_CONSTANT:
            raise InputError(f"{where} gives {function}() something other than a number up to {_LARGEST_CONSTANT}.")
    return _innermost_column(tree.args[0], where)


def _check_column(name: str, table: Table, where: str) -> str:
    if name not in table.columns:
        raise InputError(f"{where} names {name[:60]!r}, which is no column; there is {', '.join(table.columns)}.")
    return name


def _make_variable(table: Table, name: str, column: str, *, classes: bool) -> tuple[Variable, Sequence[str | float]]:
    """Return a column as a variable, and its values, at least two of which differ."""
    if not classes:
        numbers = table.numbers(name)
        if np.ptp(numbers) == 0:
            raise InputError(f"{table.where}: {name!r} is {numbers[0]:g} for all {len(table)} shapes; remove it.")
        low, high = (float(value) for value in np.percentile(numbers, [5, 95]))
        two = len(set(numbers.tolist())) == 2
        if two or low == high:
            low, high = float(numbers.min()), float(numbers.max())
        groups = (_group_label(low), _group_label(high)) if two else ()
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


def _group_label(value: float) -> str:
    return f"{value:.15g}"


def _first_line(error: Exception) -> str:
    text = re.sub(r"\x1b\[[0-9;]*m|[⧛⧚]", "", str(error)).strip()
    return (text.splitlines() or [type(error).__name__])[0][:120].rstrip(".")
