"""Registry of methods: those that come with eitskin, and those that a user names the code of."""

from eitskin.errors import DataError
from eitskin.training.baselines.greit_centroid import GreitMethod
from eitskin.training.baselines.regressions import ExtraTreesMethod, MlpMethod, RidgeMethod
from eitskin.training.joint.method import JointMethod
from eitskin.training.method.interface import Method
from eitskin.training.paper.method import PaperMethod
from eitskin.training.pipeline.own_methods import MethodCodeError

SHIPPED_METHODS: dict[str, type[Method]] = {
    method.KIND: method
    for method in (
        JointMethod,
        PaperMethod,
        RidgeMethod,
        MlpMethod,
        ExtraTreesMethod,
        GreitMethod,
    )
}


def method_class(kind: str, own: type[Method] | None = None) -> type[Method]:
    """Class of the method that is named `kind`.

    Args:
        kind: as `Method.KIND` of a shipped method, or MODULE:CLASS of one of the user's own.
        own: class that the user has named the code of; None without.

    Raises:
        DataError: for a method that neither eitskin nor the user has.
        MethodCodeError: for a method of the user's whose code is not named or is another one,
            or a named code where a shipped method needs none.
    """
    if kind in SHIPPED_METHODS:
        if own is None:
            return SHIPPED_METHODS[kind]
        raise MethodCodeError(
            f"expected no code for the method '{kind}', which comes with eitskin, got {own.KIND}; "
            "leave --method out"
        )
    module, colon, name = kind.rpartition(":")
    if not colon:
        raise DataError(
            f"expected a method of {', '.join(SHIPPED_METHODS)}, got '{kind}'; install a newer "
            "eitskin"
        )
    if own is None:
        raise MethodCodeError(
            f"this pipeline was trained by {kind}, which does not come with eitskin, and opening a "
            f"pipeline runs no code by itself: name its code with --method {module}.py:{name} "
            f"(in Python: Pipeline.load(path, method={name}))"
        )
    if own.KIND.rpartition(":")[2] != name:
        raise MethodCodeError(
            f"this pipeline was trained by {kind}, got the code of {own.KIND}; name that of {name}"
        )
    return own
