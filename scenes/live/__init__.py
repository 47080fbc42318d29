"""The live viewer: characters in a browser, driven by keys, gamepads, sliders and drawn paths (viser).

It drives characters in processes of their own (controllers.steering.process).
"""
