#!/bin/sh
# SPDX-License-Identifier: MIT
# All checks of the engine on a graphics card: sh benchmarks/gpu.sh [--arch cuda|vulkan] [--json]; --quick on the CPU.
# PYTHON names the interpreter of the project's environment, python3 otherwise.
exec "${PYTHON:-python3}" -m physgen.benchmarks.gpu "$@"
