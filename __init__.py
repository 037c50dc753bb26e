"""A clone of this repository that is itself imported as a package, because the folder above it is on the path.

`python script.py` beside a clone that is called warpcage finds this folder as `warpcage` before any installed package.
It hands over to the package inside, which is then imported as usual.
"""

import os

__path__ = [os.path.join(os.path.dirname(os.path.abspath(__file__)), "warpcage")]
__file__ = os.path.join(__path__[0], "__init__.py")
with open(__file__, encoding="utf-8") as _source:
    exec(compile(_source.read(), __file__, "exec"))
