"""The live viewer: characters in a browser, driven by sliders, keys and drawn paths (viser).

It knows a LiveCharacter (mapctl.runtime.live_protocol) and nothing of how one is steered.
"""
