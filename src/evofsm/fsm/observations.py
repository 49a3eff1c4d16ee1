"""Put continuous and discrete variables into one observation: the paper's Section 2.1.1.

States are found by Euclidean distance, so a discrete variable has a coordinate for each category,
``distance / sqrt(2)`` for the present one and 0 for the others: any two lie ``distance`` apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from evofsm.fsm.validation import Floats, number, positive


@dataclass(frozen=True)
class Category:
    """A discrete variable and how far apart its categories count.

    Above a machine's ``radius`` no state moves from one category to another.

    Examples
    --------
    >>> light = Category("light", ("red", "green"), distance=10.0)
    >>> red, green = (ObservationEncoder(light).encode({"light": value}) for value in light.values)
    >>> round(math.dist(red, green), 9)
    10.0
    """

    name: str
    values: Sequence[str]  #: all the categories it may take, two or more
    distance: float = 1.0  #: between any two of them, in the unit of the other variables

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", tuple(self.values))
        if len(set(self.values)) < 2 or len(set(self.values)) < len(self.values):
            raise ValueError(f"{self.name}: needs two or more different values, not {self.values}")
        positive(f"{self.name}: distance", self.distance)


class ObservationEncoder:
    """Turns named variables, continuous and discrete, into the vector a machine observes.

    It is given a name for each continuous variable, and a `Category` for each discrete one.

    Examples
    --------
    >>> encoder = ObservationEncoder("gap", Category("light", ("red", "green")))
    >>> encoder.names
    ('gap', 'light=red', 'light=green')
    >>> encoder.encode({"gap": 12.0, "light": "green"}).round(3)
    array([12.   ,  0.   ,  0.707])
    """

    def __init__(self, *variables: str | Category) -> None:
        if not variables:
            raise ValueError("an observation needs at least one variable")
        self.variables = variables
        #: Of each entry of the vector; ``light=red`` for a category.
        self.names: tuple[str, ...] = ()
        for variable in variables:
            if isinstance(variable, Category):
                self.names += tuple(f"{variable.name}={value}" for value in variable.values)
            else:
                self.names += (variable,)
        if len(set(self.names)) < len(self.names):
            raise ValueError(f"variables have the same name twice: {', '.join(self.names)}")

    def encode(self, values: Mapping[str, float | str]) -> Floats:
        """(len(names),) vector of a number or category for each variable; others are left out."""
        vector: list[float] = []
        for variable in self.variables:
            name = variable.name if isinstance(variable, Category) else variable
            if name not in values:
                raise ValueError(f"observation lacks {name!r}; it has {', '.join(values)}")
            value = values[name]
            if not isinstance(variable, Category):
                vector.append(number(name, value))
            elif value in variable.values:
                height = variable.distance / math.sqrt(2.0)
                vector += [height * (value == category) for category in variable.values]
            else:
                raise ValueError(f"{name} is {value!r}; it may be {', '.join(variable.values)}")
        return np.array(vector)
