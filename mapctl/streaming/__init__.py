"""Streaming to other programs: poses over the VMC protocol, orders over OSC.

`sender` and `receiver` need the package python-osc: pip install 'mapctl[stream]'.
"""
