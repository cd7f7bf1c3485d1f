# SPDX-License-Identifier: MIT
"""The program examines itself on data whose causes it is not told."""
