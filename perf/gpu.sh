#!/usr/bin/env bash
# Measures everything that wants a GPU, in order of importance; what is there already is gone on with.
#
#   PHOTOS=folder RECORDING=davis240c_camerashake.npz HIDDEN=folder perf/gpu.sh OUT [STEP...]
#
# Steps: tests, kernels, synth, scaling, training, diagnosis, learning. PYTHON names the interpreter, COMMIT
# the commit where there is no git. Each step writes its log and its tables into OUT; none stops the others.
set -uo pipefail
cd "$(dirname "$0")/.."
out=$1 && shift
steps=("${@:-}")
[ -n "${steps[0]}" ] || steps=(tests kernels synth scaling training diagnosis learning)
python=${PYTHON:-python3}
commit=${COMMIT:-$(git describe --always --dirty)}
export PYTHONPATH=$PWD:${PYTHONPATH:-} PYTHONUNBUFFERED=1
mkdir -p "$out"

run() { # NAME COMMAND...
    local name=$1 begin=$SECONDS && shift
    "$@" >"$out/$name.log" 2>&1
    echo "$name: status $?, $((SECONDS - begin)) s: $(tail -n 1 "$out/$name.log")"
}

for step in "${steps[@]}"; do
    case $step in
    tests) run tests "$python" -m pytest -q -p no:cacheprovider --device cuda:0 tests/test_{pixel,pixel_invariants,lanes,effects,effects_more,effects_voltage,effects_noise,pairs,readout,readout_stages,labels,counts,scene,autograd_scene,autograd_scene_differences,patches,probes,optics,camera,static}.py ;;
    kernels)
        run kernels_4k "$python" perf/bench_kernels.py --device cuda --size 3840x2160
        run kernels_vga "$python" perf/bench_kernels.py --device cuda --size 640x480 ;;
    synth) for jobs in 1 8; do
        run "synth_$jobs" "$python" perf/bench_synth.py --images "${PHOTOS:-builtin}" --backend cuda --jobs "$jobs"
    done ;;
    scaling)
        mkdir -p "$out/docs"
        run scaling "$python" perf/scaling.py --device cuda --out "$out/docs" ;;
    training) run training "$python" perf/bench_training.py --images "${PHOTOS:-builtin}" --commit "$commit" --out "$out/training.json" ;;
    diagnosis) run diagnosis "$python" perf/hidden_effects.py --jobs "${JOBS:-14}" --device cuda:0 --minutes "${MINUTES:-12}" --log "$out/hidden_effects.jsonl" ${HIDDEN:+--hidden "$HIDDEN"} ;;
    learning) run learning "$python" perf/adaptation.py --plan all --jobs 6 --alone 2 --budget "${BUDGET:-560}" --images "${PHOTOS:-builtin}" ${RECORDING:+--recording "$RECORDING"} --commit "$commit" --out "$out/adaptation" ;;
    *) echo "there is no step '$step'" && exit 2 ;;
    esac
done
