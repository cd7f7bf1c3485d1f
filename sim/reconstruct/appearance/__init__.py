# SPDX-License-Identifier: MIT
"""Appearance of objects without the photo's light: albedo, roughness, metallic.

appearance_estimate.py   the estimate of each object
object_shading.py        the light that reaches its surface
albedo.py                the texture without that
reflectance_fit.py       roughness and metallic from highlights
fur.py                   whether it is furry
"""
