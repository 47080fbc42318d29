"""The live viewer: characters in a browser, driven by keys, gamepads, sliders and drawn paths (viser).

It drives a LiveCharacter (mapctl.runtime.live_protocol), however that is steered.
"""
