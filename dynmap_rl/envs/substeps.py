"""The substeps of a control step: 1 ms each, while the cart's velocity goes linearly from one value to another.

Compiled, LLVM calls PyMunk's own C functions without the interpreter in between, for one world or for many, which is about
five times faster than the plain loop and gives the same bits.
"""

from __future__ import annotations

import functools
import itertools
import os
import platform
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pymunk

Bodies = tuple[pymunk.Space, pymunk.Body, pymunk.Body]  # a space, its cart and its block
Run = Callable[[Sequence[Bodies], np.ndarray, np.ndarray, int, float, int], np.ndarray]
SHARE = 4  # worlds, from which on a thread of their own is worth its while


def run_plain(
    worlds: Sequence[Bodies], before: np.ndarray, after: np.ndarray, steps: int, dt: float, threads: int = 1
) -> np.ndarray:
    """Step every space ``steps`` times by ``dt`` (s); in each the cart moves at the velocity of the substep's middle.

    Args:
        before, after: the cart's velocity at the start and at the end, float64 ``[N, 3]`` (m/s, m/s, rad/s).
        threads: among which the compiled form divides the worlds; Python itself has use for one.

    Returns:
        What :func:`read_bodies` then says of each world, ``[N, 12]``.
    """
    for (space, cart, _), b, a in zip(worlds, before.tolist(), after.tolist(), strict=True):
        for i in range(steps):
            middle = (i + 0.5) / steps
            _steer(cart, *(x + (y - x) * middle for x, y in zip(b, a, strict=True)))
            space.step(dt)
        _steer(cart, *a)
    return np.array([read_bodies(cart, block) for _, cart, block in worlds])


def _steer(cart: pymunk.Body, x: float, y: float, angular: float) -> None:
    cart.velocity = (x, y)
    cart.angular_velocity = angular


def read_bodies(*bodies: pymunk.Body) -> list[float]:
    """Positions x, y, angle of each, then their velocities."""
    positions = [value for body in bodies for value in (*body.position, body.angle)]
    return positions + [value for body in bodies for value in (*body.velocity, body.angular_velocity)]


@functools.cache
def choose_run() -> Run:
    """The compiled form of :func:`run_plain`, or that itself where it cannot be compiled."""
    machine = platform.machine().lower()
    # Here a C vector is passed, and returned, as its two numbers.
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


FUNCTIONS = (
    "cpSpaceStep",
    *(f"cpBodySet{what}" for what in ("Velocity", "AngularVelocity")),
    *(f"cpBodyGet{what}" for what in ("Position", "Angle", "Velocity", "AngularVelocity")),
)
# Worlds are rows of three pointers (space, cart, block), velocities rows of three numbers.
LOOPS = """
declare void @cpSpaceStep(ptr, double)
declare void @cpBodySetVelocity(ptr, double, double)
declare void @cpBodySetAngularVelocity(ptr, double)
declare {double, double} @cpBodyGetPosition(ptr)
declare {double, double} @cpBodyGetVelocity(ptr)
declare double @cpBodyGetAngle(ptr)
declare double @cpBodyGetAngularVelocity(ptr)

define ptr @pointer(ptr %worlds, i64 %world, i64 %which) alwaysinline {
  %at = getelementptr [3 x ptr], ptr %worlds, i64 %world, i64 %which
  %found = load ptr, ptr %at
  ret ptr %found
}

define double @entry(ptr %velocities, i64 %world, i64 %axis) alwaysinline {
  %at = getelementptr [3 x double], ptr %velocities, i64 %world, i64 %axis
  %value = load double, ptr %at
  ret double %value
}

define double @between(ptr %before, ptr %after, i64 %world, i64 %axis, double %middle) alwaysinline {
  %b = call double @entry(ptr %before, i64 %world, i64 %axis)
  %a = call double @entry(ptr %after, i64 %world, i64 %axis)
  %change = fsub double %a, %b
  %part = fmul double %change, %middle
  %value = fadd double %b, %part
  ret double %value
}

; All substeps, and the cart's velocity after the last.
define void @run(ptr %worlds, ptr %before, ptr %after, i64 %n, i64 %steps, double %dt) {
start:
  %count = sitofp i64 %steps to double
  br label %world
world:
  %w = phi i64 [ 0, %start ], [ %next_w, %end_world ]
  %space = call ptr @pointer(ptr %worlds, i64 %w, i64 0)
  %cart = call ptr @pointer(ptr %worlds, i64 %w, i64 1)
  br label %substep
substep:
  %i = phi i64 [ 0, %world ], [ %next, %substep ]
  %number = sitofp i64 %i to double
  %shifted = fadd double %number, 0.5
  %middle = fdiv double %shifted, %count
  %x = call double @between(ptr %before, ptr %after, i64 %w, i64 0, double %middle)
  %y = call double @between(ptr %before, ptr %after, i64 %w, i64 1, double %middle)
  %turn = call double @between(ptr %before, ptr %after, i64 %w, i64 2, double %middle)
  call void @cpBodySetVelocity(ptr %cart, double %x, double %y)
  call void @cpBodySetAngularVelocity(ptr %cart, double %turn)
  call void @cpSpaceStep(ptr %space, double %dt)
  %next = add i64 %i, 1
  %more = icmp slt i64 %next, %steps
  br i1 %more, label %substep, label %end_world
end_world:
  %last_x = call double @entry(ptr %after, i64 %w, i64 0)
  %last_y = call double @entry(ptr %after, i64 %w, i64 1)
  %last_turn = call double @entry(ptr %after, i64 %w, i64 2)
  call void @cpBodySetVelocity(ptr %cart, double %last_x, double %last_y)
  call void @cpBodySetAngularVelocity(ptr %cart, double %last_turn)
  %next_w = add i64 %w, 1
  %more_w = icmp slt i64 %next_w, %n
  br i1 %more_w, label %world, label %end
end:
  ret void
}

define void @body(ptr %body, ptr %out, i64 %first) alwaysinline {
  %place = call {double, double} @cpBodyGetPosition(ptr %body)
  %angle = call double @cpBodyGetAngle(ptr %body)
  %speed = call {double, double} @cpBodyGetVelocity(ptr %body)
  %turn = call double @cpBodyGetAngularVelocity(ptr %body)
  %at = getelementptr double, ptr %out, i64 %first
  %at_angle = getelementptr double, ptr %at, i64 2
  %at_speed = getelementptr double, ptr %at, i64 6
  %at_turn = getelementptr double, ptr %at, i64 8
  store {double, double} %place, ptr %at
  store double %angle, ptr %at_angle
  store {double, double} %speed, ptr %at_speed
  store double %turn, ptr %at_turn
  ret void
}

; What all bodies then do, in rows of twelve.
define void @read(ptr %worlds, ptr %out, i64 %n) {
start:
  br label %world
world:
  %w = phi i64 [ 0, %start ], [ %next, %world ]
  %cart = call ptr @pointer(ptr %worlds, i64 %w, i64 1)
  %block = call ptr @pointer(ptr %worlds, i64 %w, i64 2)
  %row = getelementptr [12 x double], ptr %out, i64 %w
  call void @body(ptr %cart, ptr %row, i64 0)
  call void @body(ptr %block, ptr %row, i64 3)
  %next = add i64 %w, 1
  %more = icmp slt i64 %next, %n
  br i1 %more, label %world, label %end
end:
  ret void
}
"""


def _compile() -> Run:
    from llvmlite import binding as llvm
    from pymunk._chipmunk import ffi, lib

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    for name in FUNCTIONS:
        llvm.add_symbol(name, int(ffi.cast("intptr_t", ffi.addressof(lib, name))))
    machine = llvm.Target.from_default_triple().create_target_machine(opt=2)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(LOOPS), machine)
    engine.finalize_object()
    run, read = (
        ffi.cast(f"void (*)({signature})", engine.get_function_address(name))
        for name, signature in {
            "run": "void *, void *, void *, int64_t, int64_t, double",
            "read": "void *, void *, int64_t",
        }.items()
    )

    def run_compiled(worlds, before, after, steps, dt, threads=1) -> np.ndarray:
        structs = ffi.new("void *[]", [p for s, c, b in worlds for p in (s._space, c._body, b._body)])
        out = np.empty((len(worlds), 12))

        def run_share(first: int, end: int) -> None:  # without the interpreter's lock, but for callbacks
            velocities = (ffi.from_buffer(array[first:end]) for array in (before, after))
            run(structs + 3 * first, *velocities, end - first, steps, dt)

        for space, _, _ in worlds:
            space._locked = True
        try:
            _divide(run_share, len(worlds), threads)
        finally:
            for space, _, _ in worlds:
                space._locked = False
        for space, _, _ in worlds:
            if space._add_later or space._remove_later or space._post_step_callbacks:
                space.step(0.0)  # PyMunk now does what callbacks asked for; no time passes in it
        read(structs, ffi.from_buffer(out), len(worlds))
        return out

    run_compiled.engine = engine  # owns the machine code
    return run_compiled


def _divide(work: Callable[[int, int], None], count: int, threads: int) -> None:
    """``work(first, end)`` on shares of ``range(count)``, the first of them here, the others on threads."""
    threads = max(1, min(threads, count // SHARE))
    ends = [count * i // threads for i in range(threads + 1)]
    first, *others = itertools.pairwise(ends)
    others = [_pool(os.getpid()).submit(work, *share) for share in others]
    try:
        work(*first)
    finally:  # interrupted, too, nothing goes on behind the caller's back
        for other in others:
            other.result()


@functools.cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Of each process its own: threads do not outlive a fork."""
    return ThreadPoolExecutor(thread_name_prefix="substeps")
