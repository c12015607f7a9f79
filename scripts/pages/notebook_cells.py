# %% [markdown]
# # A calibration in a notebook
#
# A recorded step of the dc voltage set-point calibrates the dc voltage controller of the shipped link. This page was executed
# when the site was built; [the notebook file](files/calibration.ipynb) holds the same cells and their outputs.
# %%
import numpy as np

import hvdc_ident as hi

link = hi.load_model("vsc-hvdc-link")
t = np.linspace(0, 0.9, 901)
# %% [markdown]
# ## A recording
#
# The plant has other gains than the model, and its transducers add noise. A recording of your own comes from a file:
# `hi.read_waveforms("recording.csv")`.
# %%
plant = link.with_values({"KPVDC": 20.0, "KIVDC": 850.0})
step = hi.step(1.0, 1.019, at=0.1)
noise = 1e-4 * np.random.default_rng(0).standard_normal(t.size)
measured = hi.simulate(plant, t, inputs={"Vdcref1": step})["Irorder1"] + noise
record = hi.Experiment(t, inputs={"Vdcref1": step}, outputs={"Irorder1": measured})
hi.simulate(link, record).plot("Irorder1")
# %% [markdown]
# ## What does it determine?
# %%
bounds = {"KPVDC": (10, 40), "KIVDC": (300, 1500)}
report = hi.identify(link, record, bounds)
print(report)
# %% [markdown]
# ## The gains
# %%
fit = hi.fit(link, record, bounds, report=report)
print(fit)
# %%
fit.to_dataframe()
# %% [markdown]
# ## The loop that they give
# %%
fitted = link.with_values(fit.values)
print(hi.linear.margins(hi.linear.loop(fitted, "Irorder1")))
# %%
hi.bode(fitted, inputs="Vdcref1", outputs="Irorder1").plot()
