"""The options class of every command, and what must be typed with it. `dexsim_ppo.train` has one for each task."""

OPTIONS = {
    "dexsim_ppo.train": ("dexsim_ppo.train:TrainArguments", []),
    "dexsim_ppo.evaluate": ("dexsim_ppo.evaluate:EvaluateArguments", ["grasp"]),
    "dexsim_ppo.export": ("dexsim_ppo.export:ExportArguments", ["grasp", "--output", "grasp.onnx"]),
    "dexsim_ppo.record": ("dexsim_ppo.record:RecordArguments", ["grasp", "--rrd", "x.rrd"]),
    "dexsim_real.run": ("dexsim_real.run:RunArguments", ["grasp", "--port", "x", "--uncalibrated"]),
    "dexsim_real.calibrate": ("dexsim_real.calibrate.bench:CalibrateArguments", ["--port", "x"]),
    "dexsim_real.twin": ("dexsim_real.twin.__main__:TwinArguments", []),
    "dexsim_real.replay": ("dexsim_real.replay:ReplayArguments", ["x.log"]),
    "dexsim.check_hand": ("dexsim.check_hand:CheckHandArguments", ["leap_like"]),
    "dexsim.import_hand": ("dexsim.import_hand:ImportArguments", ["hand.urdf", "--out", "x"]),
    "dexsim.view": ("dexsim.view.__main__:ViewArguments", ["grasp"]),
}
