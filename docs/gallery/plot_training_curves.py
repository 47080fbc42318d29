"""
Plot how priors were trained
============================

Every model comes with a card: its data, its licence, its settings, and how it did on unseen clips in the course of
training. `mapctl info NAME -o curves.png` draws all of that; here are two numbers of three densities.
"""

import matplotlib.pyplot as plt

import priors

figure, (above, below) = plt.subplots(2, 1, figsize=(6.4, 6.0), sharex=True, layout="constrained")
for name in ("locomotion", "locomotion-live", "general"):
    card = priors.load(name).card
    curve = card.training["curve"]
    steps = [row["step"] for row in curve]
    above.plot(steps, [-row["validation_nats"] for row in curve], marker="o", markersize=3, label=name)
    below.plot(steps, [row["free_run_pose_ratio"] for row in curve], marker="o", markersize=3)
    print(f"{name}: {card.data['clips']} clips, width {card.config['width']}, {card.licence}")
above.set(title="Log likelihood of unseen clips", ylabel="nats a frame")
above.legend()
below.axhline(1.0, color="0.6", linewidth=0.8)
below.set(title="Variety of poses in free runs, beside the data's", xlabel="steps of training", ylabel="ratio")

# %%
# Likelihood says how well the next frame is foretold. Whether a motion that is drawn frame after frame stays alive is
# another question: in the plot below, poses of free runs vary as much as those of the data where the ratio is 1.
