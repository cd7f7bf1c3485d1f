# SPDX-License-Identifier: MIT
"""What pages are built of: elements, colours, style. For reports that are one file and load nothing."""
