"""The run-time check of shapes in annotations (pyproject.toml names it): a whole number is legal
where a float is, as it is to type checkers.
"""

import beartype

check = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))
