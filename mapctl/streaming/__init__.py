"""Streaming to other programs: poses over the VMC protocol, orders over OSC.

`vmc` and `orders` need nothing else; `sender` and `receiver` need the package python-osc: pip install 'mapctl[stream]'.
"""
