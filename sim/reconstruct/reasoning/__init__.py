# SPDX-License-Identifier: MIT
"""Materials of objects: from a vision-language model, a table of names, or the user.

material_decision.py   who decides: the user, the answer, the names, the default
material_names.py      usual physics by name
material_query.py      the question to a model; chat_client.py, http_post.py how it is asked
answer_parser.py       its answer: answer_rows.py rows, answer_entries.py entries, quantities.py numbers with units
"""
