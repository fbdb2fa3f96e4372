"""The calibration's live picture on the operator's screen.

`guidance` says what a person is to know at a moment, `canvas` draws it, and `window` or `lines` show it and give the
keys that were pressed.
"""
