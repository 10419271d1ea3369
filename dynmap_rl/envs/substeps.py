"""The substeps of a control step: 1 ms each, while the cart's velocity goes linearly from one value to another.

Compiled, LLVM calls PyMunk's own C functions without the interpreter in between, which is about five times faster than
the plain loop and gives the same bits.
"""

from __future__ import annotations

import ctypes
import functools
import platform
import sys
from collections.abc import Callable

import pymunk

Velocity = tuple[float, float, float]  # m/s, m/s, rad/s
Run = Callable[[pymunk.Space, pymunk.Body, Velocity, Velocity, int, float], None]


def run_plain(
    space: pymunk.Space, cart: pymunk.Body, before: Velocity, after: Velocity, steps: int, dt: float
) -> None:
    """Step the space ``steps`` times by ``dt`` (s); in each the cart moves at the velocity of the substep's middle."""
    for i in range(steps):
        _step(space, cart, before, after, (i + 0.5) / steps, dt)


def _step(space, cart, before, after, middle: float, dt: float) -> None:
    x, y, angular = (b + (a - b) * middle for b, a in zip(before, after, strict=True))
    cart.velocity = (x, y)
    cart.angular_velocity = angular
    space.step(dt)


@functools.cache
def choose_run() -> Run:
    """The compiled form of :func:`run_plain`, or that itself where it cannot be compiled."""
    machine = platform.machine().lower()
    # Here a C vector is passed as its two numbers.
    known = sys.platform in ("linux", "darwin") and machine in ("x86_64", "arm64", "aarch64")
    try:
        return _compile() if known else run_plain
    except (
        ImportError,
        AttributeError,
        OSError,
        RuntimeError,
    ):  # other releases of LLVM's bindings or of PyMunk
        return run_plain


FUNCTIONS = "cpBodySetVelocity", "cpBodySetAngularVelocity", "cpSpaceStep"
LOOP = """
declare void @cpBodySetVelocity(i8*, double, double)
declare void @cpBodySetAngularVelocity(i8*, double)
declare void @cpSpaceStep(i8*, double)

define double @between(double %b, double %a, double %middle) alwaysinline {
  %change = fsub double %a, %b
  %part = fmul double %change, %middle
  %value = fadd double %b, %part
  ret double %value
}

define void @run(i8* %space, i8* %cart, double %bx, double %by, double %bw,
                 double %ax, double %ay, double %aw, i64 %steps, double %dt) {
start:
  %count = sitofp i64 %steps to double
  %last = sub i64 %steps, 1
  br label %substep
substep:
  %i = phi i64 [ 0, %start ], [ %next, %substep ]
  %number = sitofp i64 %i to double
  %shifted = fadd double %number, 0.5
  %middle = fdiv double %shifted, %count
  %x = call double @between(double %bx, double %ax, double %middle)
  %y = call double @between(double %by, double %ay, double %middle)
  %w = call double @between(double %bw, double %aw, double %middle)
  call void @cpBodySetVelocity(i8* %cart, double %x, double %y)
  call void @cpBodySetAngularVelocity(i8* %cart, double %w)
  call void @cpSpaceStep(i8* %space, double %dt)
  %next = add i64 %i, 1
  %more = icmp slt i64 %next, %last
  br i1 %more, label %substep, label %end
end:
  ret void
}
"""


def _compile() -> Run:
    from llvmlite import binding as llvm
    from pymunk._chipmunk import ffi, lib

    def address(pointer) -> int:
        return int(ffi.cast("intptr_t", pointer))

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    for name in FUNCTIONS:
        llvm.add_symbol(name, address(ffi.addressof(lib, name)))
    machine = llvm.Target.from_default_triple().create_target_machine(opt=2)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(LOOP), machine)
    engine.finalize_object()
    signature = [ctypes.c_void_p] * 2 + [ctypes.c_double] * 6 + [ctypes.c_int64, ctypes.c_double]
    loop = ctypes.CFUNCTYPE(None, *signature)(engine.get_function_address("run"))

    def run_compiled(space, cart, before, after, steps, dt) -> None:
        # The last substep is PyMunk's own, which does what callbacks asked for: to add and to remove shapes.
        space._locked = True
        try:
            loop(address(space._space), address(cart._body), *before, *after, steps, dt)
        finally:
            space._locked = False
        _step(space, cart, before, after, (steps - 0.5) / steps, dt)

    run_compiled.engine = engine  # owns the machine code
    return run_compiled
