"""Headers of public exports: what each column is, by name and unit. A column is understood or left open, and never taken for another."""

from __future__ import annotations

import pytest

from hvdc_ident.data.quantities import Reading, read_columns
from hvdc_ident.formats._labels import names_and_units

V, A, F, P, Q = "voltage", "angle", "frequency", "active power", "reactive power"

# The header, and of it what a plant's terminals give: by the number of the column its quantity. All others are a phase, a current, a
# reference or left open.
HEADERS: dict[str, tuple[str, dict[int, str]]] = {
    # csv of the ISO-NE and WECC cases in the Test Cases Library of Power System Sustained Oscillations (curent.utk.edu): bus, VM, VA, ...
    "oscillation cases": ("Sub1:Ln1:VM,Sub1:Ln1:VA,Sub1:Ln1:F,Sub1:Ln1:P,Sub1:Ln1:Q", {0: V, 1: A, 2: F, 3: P, 4: Q}),
    # PNNL Archive Walker, JSIS_CSV: signal types in the second header row
    "JSIS": ("VMP,VAP,IMP,IAP,P,Q,F,RCF", {0: V, 1: A, 4: P, 5: Q, 6: F}),
    # PingThings NI4AI, nomenclature.py of ni4ai-ingest
    "NI4AI": (
        "Positive Seq Volt Mag [volts],Positive Seq V Ang [deg],Positive Seq I Mag [amps],Positive Seq I Ang [deg],"
        "Phase A Volt Mag [volts],Phase A Volt Ang [deg],Phase A I Mag [amps],Frequency [Hz],P (in MW),Q (in MVAR)",
        {0: V, 1: A, 7: F, 8: P, 9: Q},
    ),
    # GPA openPDC and openHistorian: the phasor's number does not say its phase
    "openPDC": (
        "GPA_SHELBY-PM1:V,GPA_SHELBY-PA1:VH,GPA_SHELBY-PM2:I,GPA_SHELBY-PA2:IH,GPA_SHELBY:FREQ,GPA_SHELBY:DFDT",
        {4: F},
    ),
    # Power system attack data sets of Mississippi State University and ORNL: relays with openPDC
    "MSU/ORNL": (
        "R1-PA1:VH,R1-PM1:V,R1-PA2:VH,R1-PM2:V,R1-PA4:IH,R1-PM4:I,R1-PA7:VH,R1-PM7:V,R1:F,R1:DF,R1-PA:Z,R1-PA:ZH,R1:S",
        {8: F},
    ),
    # GPA openECA and SIEGate, alternate tags
    "openECA": (
        "SHELBY_500KV_V1LPM.Magnitude,SHELBY_500KV_V1LPM.Angle,SHELBY_I1SPM.Magnitude,SHELBY_I1SPM.Angle,SHELBY.Frequency,SHELBY.dF/dt",
        {0: V, 1: A, 4: F},
    ),
    # BPA and SEL-421 channel names of IEEE C37.118 configuration frames
    "C37.118 names": ("V1LPM,VALPM,VBLPM,VCLPM,I1WPM,IAWPM", {0: V}),
    # PMU Edge AI CSV Protocol v1.2
    "PMU edge": (
        "DFDT,FREQ,IA_MAG,IA_ANG,IB_MAG,IB_ANG,IC_MAG,IC_ANG,VA_MAG,VA_ANG,VB_MAG,VB_ANG,VC_MAG,VC_ANG,ERROR_CODE",
        {1: F},
    ),
    # pyMU, pmuToCsv.py
    "pyMU": (
        "Va_Mag,Va_Deg,Vb_Mag,Vb_Deg,Vc_Mag,Vc_Deg,Ia_Mag,Ia_Deg,Ib_Mag,Ib_Deg,Ic_Mag,Ic_Deg,Freq,ROCOF",
        {12: F},
    ),
    # PSL microPMU, LBNL open data: L1 to L3 the voltages, C1 to C3 the currents
    "microPMU": ("L1MAG,L1ANG,L2MAG,L2ANG,L3MAG,L3ANG,C1MAG,C1ANG,C2MAG,C2ANG,C3MAG,C3ANG", {}),
    # Aspen OneLiner, relay quantities of a fault script
    "relay quantities": (
        "Ia_mag,Ia_ang,Va_mag,Va_ang,Vb_mag,Vb_ang,I0_mag,I0_ang,I1_mag,I1_ang,V0_mag,V0_ang,V1_mag,V1_ang,V2_mag,V2_ang",
        {12: V, 13: A},
    ),
    # SEL relays, event reports and COMTRADE channels: waveforms of phases
    "SEL event": ("IA [A],IB [A],IC [A],IN [A],VA [kV],VB [kV],VC [kV],VDC [V],FREQ [Hz]", {8: F}),
    # SEL synchrophasor and SEL-5078: a concentrator's csv
    "SEL PDC": (
        "SEL-421 V1 MAG (kV),SEL-421 V1 ANG (deg),SEL-421 I1 MAG (A),SEL-421 I1 ANG (deg),SEL-421 FREQ (Hz),SEL-421 DFDT (Hz/s)",
        {0: V, 1: A, 4: F},
    ),
    # PI tags of a plant, as ISO New England and BPA list them for playback
    "PI tags": (
        "MAIN STREET 500 KV VP MAG,MAIN STREET 500 KV VP ANG,MAIN STREET FREQ,MAIN STREET GEN 1 MW,MAIN STREET GEN 1 MVAR",
        {0: V, 1: A, 2: F, 3: P, 4: Q},
    ),
    # PSS/E: channels of dyntools' csv
    "PSS/E": (
        "POWR 101,VARS 101,ETRM 101,EFD 101,PMEC 101,SPD 101,ANGL 101,FREQ 101",
        {0: P, 1: Q, 2: V, 7: F},
    ),
    # DIgSILENT PowerFactory: variables of a result file
    "PowerFactory": (
        "m:u1 in p.u.,m:phiu1 in deg,m:fehz in Hz,m:Psum:bus1 in MW,m:Qsum:bus1 in Mvar,s:ve in p.u.",
        {0: V, 1: A, 2: F, 3: P, 4: Q},
    ),
    # pandapower: result tables as csv
    "pandapower": ("vm_pu,va_degree,p_mw,q_mvar", {0: V, 1: A, 2: P, 3: Q}),
    # SunSpec model 103, pysunspec: VA beside W and VAr is a power
    "SunSpec": ("A,AphA,AphB,AphC,PPVphAB,PhVphA,PhVphB,PhVphC,W,Hz,VAr,PF", {9: F, 10: Q}),
    # German protection recorders: Siemens SIGRA, DIGSI
    "SIGRA": (
        "UL1 [kV],UL2 [kV],UL3 [kV],IL1 [A],IL2 [A],IL3 [A],Netzfrequenz [Hz],Wirkleistung [MW],Blindleistung [Mvar]",
        {6: F, 7: P, 8: Q},
    ),
    # Power quality meters: Janitza, Schneider
    "meter": (
        "VRMS A,VRMS B,VRMS C,IRMS A,IRMS B,IRMS C,Active Power(W) A,Reactive Power(VAR) A,Power Factor A,VTHD A",
        {},
    ),
    # A plant's own recorder, references beside what is measured
    "plant": (
        "Gen1.P_ref [MW],Gen1.P [MW],Gen1.Q [Mvar],Gen1.Vt [kV],Gen1.Efd [pu],Gen1.V_ref [pu],Gen1.Rotor_Angle [deg]",
        {1: P, 2: Q, 3: V},
    ),
    # Fingrid and Statnett open data: deviation
    "deviation": ("PMU1_VOLTAGE_POS_SEQ_MAG,PMU1_VOLTAGE_POS_SEQ_ANG,PMU1_FREQUENCY_DEVIATION", {0: V, 1: A, 2: F}),
    "phasors": ("VPM_kV,VPA_deg,IPM_A,IPA_deg,FREQ,DFREQ,MW,MVAR", {0: V, 1: A, 4: F, 6: P, 7: Q}),
    "words": ("Voltage,Angle,ActivePower,ReactivePower", {0: V, 1: A, 2: P, 3: Q}),
}
TERMINALS = {V, A, F, P, Q}


def readings(header: str) -> tuple[Reading, ...]:
    return read_columns(*names_and_units(header.split(",")))


@pytest.mark.parametrize("habit", HEADERS)
def test_a_header_is_understood_or_left_open(habit: str) -> None:
    header, expected = HEADERS[habit]
    found = {k: r.measured for k, r in enumerate(readings(header)) if r.measured in TERMINALS}
    assert found == expected


@pytest.mark.parametrize(
    ("header", "phases"),
    [
        ("V1,V2,V3", ["a", "b", "c"]),
        ("V0,V1,V2", ["0", "1", "2"]),
        ("V1,I1,P,Q", ["1", "1", "", ""]),
        ("V1 Mag,V1 Ang", ["1", "1"]),
        ("VA,VB,VC", ["a", "b", "c"]),
        ("UL1,UL2,UL3", ["a", "b", "c"]),
        ("V1,V2", ["", ""]),  # two phases, two sequences, or two buses: not said
    ],
)
def test_phases_and_sequences_are_told_from_the_columns_together(header: str, phases: list[str]) -> None:
    assert [r.phase for r in readings(header)] == phases


def test_va_is_a_phase_beside_two_others_and_an_angle_beside_a_magnitude() -> None:
    assert [r.measured for r in readings("VM,VA")] == [V, A]
    assert [(r.quantity, r.phase) for r in readings("VA [kV],VB [kV],VC [kV]")] == [(V, "a"), (V, "b"), (V, "c")]
    assert [r.measured for r in readings("VA,P")] == ["", P]


def test_the_unit_decides_where_the_name_says_two_things() -> None:
    (reading,) = readings("VA [deg]")
    assert reading.measured == A
    (reading,) = readings("V [deg]")
    assert reading.measured == A
    (reading,) = readings("power [MVA]")
    assert reading.measured != Q


def test_the_place_is_what_is_left_of_a_name() -> None:
    assert [r.place for r in readings("EASTFIELD12 V1 Mag [kV],EASTFIELD12 P [MW]")] == [("EASTFIELD12",)] * 2
