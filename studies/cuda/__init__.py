"""The CUDA backend without a GPU, by a stand-in for its driver that runs Dr.Jit's PTX on the CPU.

- `suite`: the tests, on cuda_ad_mono
- `assemble`: every kernel through NVIDIA's assembler: does it compile, how many registers, does it spill
- `work`: what is counted: one image of a cloud, its derivatives, a step of a fit
- `count`: instructions and memory sectors of that work
- `waits`: how often a step waits for the device, copies, loads and launches kernels
- `measure`: times on a GPU of the same work, beside those that `lingo_mi.validation.cuda_model` predicts

The stand-in is a program that runs a command with its driver. It is told what to do by environment variables: CUDA_ON_CPU_SM
(compute capability times ten), _DUMP (a folder for the PTX of every module), _PROFILE (a folder for counts), _NOISE and _CHECK.
"""
