"""The panel of the live viewer: tabs in an order, and the controls in them."""
