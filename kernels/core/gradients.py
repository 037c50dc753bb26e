"""Functions through which no gradient passes: a wp.Tape that asks for one gets NaN, and a line is printed."""

# Warp calls the adjoint of C++ (`wp.func_native`) if it takes an argument: where none is given, a gradient is zero in
# silence. In loops whose length is not known, in which numbers change that others are made of, it is wrong in silence.
# On its way back Warp leaves loops out until it comes to them and may take another `return` after one: each refuses.
# What is here speaks instead, once in each Warp module, where a slope that is not zero comes back.

from typing import Any

import warp as wp

_FLOATS = (float, wp.float32, wp.float64)


def _scalar(kind: Any) -> Any:
    return getattr(kind, "_wp_scalar_type_", kind)


def _numbers(kind: Any, path: str) -> list[str]:
    """The floats, and vectors and matrices of floats, that a value of a type holds, as paths in C++."""
    if isinstance(kind, wp.array):
        return []
    if hasattr(kind, "vars"):  # a struct
        return [each for name, var in kind.vars.items() for each in _numbers(var.type, f"{path}.{name}")]
    return [path] if _scalar(kind) in _FLOATS else []


def _arrays(kind: Any, path: str) -> list[str]:
    """The arrays of such numbers that a value of a type holds."""
    if isinstance(kind, wp.array):
        return [path] if _scalar(kind.dtype) in _FLOATS else []
    if hasattr(kind, "vars"):
        return [each for name, var in kind.vars.items() for each in _arrays(var.type, f"{path}.{name}")]
    return []


def refusal(who: str, arguments: dict[str, Any], result: Any) -> str:
    """The adjoint in C++ of a function that has none. who: what its line names; arguments: types by names."""
    numbers = [each for name, kind in arguments.items() for each in _numbers(kind, f"adj_{name}")]
    arrays = [each for name, kind in arguments.items() for each in _arrays(kind, name)]
    if _numbers(result, ""):
        text = """
    bool slope_asked = false;  // names that no argument has
    const unsigned char* slope_bytes = reinterpret_cast<const unsigned char*>(&adj_ret);
    for (int i = 0; i < (int)sizeof(adj_ret); ++i)
        slope_asked |= (slope_bytes[i] & (i % 4 == 3 ? 0x7f : 0xff)) != 0;  // -0.0 asks for nothing
"""
    elif arrays:  # which may be written
        text = f"\n    const bool slope_asked = {' || '.join(f'{each}.grad' for each in arrays)};\n"
    else:
        return ""
    return f"""{text}    if (!slope_asked)
        return;
    static int slope_refused = 0;
#if defined(__CUDA_ARCH__)
    const int slope_refusals = atomicExch(&slope_refused, 1);
#else
    const int slope_refusals = slope_refused;
    slope_refused = 1;
#endif
    if (slope_refusals == 0)
        printf("warpcage: no gradient passes through {who}: slopes are NaN, see Gradients in docs/arrays.md\\n");
""" + "".join(
        [f"    {each} = NAN;\n" for each in numbers]
        + [f"    if ({each}.grad && {each}.shape[0] > 0)\n        {each}.grad[0] = NAN;\n" for each in arrays]
    )


class forward:
    """`@forward.func_native(snippet)` declares C++ through which no gradient passes."""

    @staticmethod
    def func_native(snippet: str) -> Any:  # Warp reads the result of C++ from its types if the decorator is called so
        """As `wp.func_native`."""

        def declared(function: Any) -> Any:
            arguments = dict(function.__annotations__)
            result = arguments.pop("return", None)
            return wp.func_native(snippet, refusal(function.__name__, arguments, result))(function)

        return declared


def forward_only_in(file: str, *kinds: tuple[Any, ...]) -> Any:
    """`forward_only(value, place)` of a kernel file, for pairs of types: the value, through which no gradient passes to
    `place`. `forward_only(array)`, for the type of an array alone: no gradient passes from what is written there."""
    who = f"a function of {file}"
    for kind in kinds:
        if len(kind) == 2:
            value_type, place_type = kind

            @wp.func_native("return value;", refusal(who, {"value": value_type, "place": place_type}, value_type))
            def forward_only(value: value_type, place: place_type) -> value_type: ...

        else:
            (array_type,) = kind

            @wp.func_native("", refusal(who, {"array": array_type}, None))
            def forward_only(array: array_type): ...

    return forward_only


class _Result:
    """What a function returns, as Warp's analysis of it would say."""

    def __init__(self, kind: Any):
        self.label, self.type = "result", kind


def gradient_of(function: Any, result: Any) -> Any:
    """`wp.func_grad` of a function that returns one value of the type `result`."""
    # Asked for what it returns, Warp analyses the function at each import, which takes a tenth of a second; it analyses
    # it anew, and for itself, when it generates code.
    function.adj.return_var = (_Result(result),)
    return wp.func_grad(function)


@wp.func_native("wp::adj_address(array, i, slopes, 0, value);")
def add_slope(array: wp.array(dtype=wp.vec3), slopes: wp.array(dtype=wp.vec3), i: int, value: wp.vec3):
    """Add to the gradient of array[i], where one is asked for. slopes: wp.adjoint[array], which arrays in structs have
    none of."""
    ...
