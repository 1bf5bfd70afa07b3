#!/usr/bin/env bash
# Measures everything that wants a GPU, and what wants many cores; what is there already is gone on with.
#
#   PHOTOS=folder RECORDING=davis240c_camerashake.npz HIDDEN=folder perf/gpu.sh OUT [STEP...]
#
# Steps: tests, kernels, synth, scaling, both, learning, matrix, training, v2e. Where a call may not take
# long, and there are several GPUs, this is two calls:
#
#   LIMIT=560 perf/gpu.sh OUT both                        learning on the GPUs, the matrix on the CPU
#   REST=240 perf/gpu.sh OUT matrix training v2e tests    the rest of the matrix, then the GPU alone
#
# LIMIT and REST are seconds; what has not ended by then is stopped, loses its last runs, and goes on when
# called again. PYTHON names the interpreter, COMMIT the commit where there is no git, DEVICES the GPUs if not
# all. Each step writes its log and its tables into OUT; none stops the others. After each of them all
# of OUT that pages need is packed into OUT.tar.gz, or PACK.
set -uo pipefail
cd "$(dirname "$0")/.."
out=$1 && shift
steps=("${@:-}")
[ -n "${steps[0]}" ] || steps=(tests kernels synth scaling both matrix training v2e)
python=${PYTHON:-python3}
commit=${COMMIT:-$(git describe --always --dirty)}
export PYTHONPATH=$PWD:${PYTHONPATH:-} PYTHONUNBUFFERED=1
cores=$(env -u OMP_NUM_THREADS nproc)
all='import torch; print(*(f"cuda:{n}" for n in range(torch.cuda.device_count())), sep=",")'
devices=${DEVICES:-$("$python" -c "$all")}
first=${devices%%,*}
room=${ROOM:-10} # cores for learning beside the matrix
mkdir -p "$out/docs"

run() { # NAME COMMAND...
    local name=$1 begin=$SECONDS && shift
    "$@" >"$out/$name.log" 2>&1
    echo "$name: status $?, $((SECONDS - begin)) s: $(tail -n 1 "$out/$name.log")"
}

on() { # CORES COMMAND...: on these alone, so that neither takes those of the other
    local cores=$1 && shift
    if command -v taskset >/dev/null; then taskset -c "$cores" "$@"; else "$@"; fi
}

learning() { # SECONDS [CORES]
    # it ends by itself, and is only kept from hanging
    run learning on "${2:-0-$((cores - 1))}" timeout -k 5 $(($1 + 20)) "$python" -m perf.experiments.adaptation.run \
        --plan all --jobs 2 --alone 2 --device "$devices" --budget "$1" --images "${PHOTOS:-builtin}" \
        ${RECORDING:+--recording "$RECORDING"} --commit "$commit" --out "$out/adaptation"
}

matrix() { # SECONDS JOBS [CORES]
    local end=$((SECONDS + $1)) where=${3:-0-$((cores - 1))}
    local blind=("$python" -m perf.experiments.blind_diagnosis.run --log "$out/hidden_effects.jsonl" --key "${KEY:-development}")
    export OMP_NUM_THREADS=1
    # one run alone compiles what the others would all compile at the same time
    run warm on "$where" timeout -k 5 "$1" "${blind[@]}" --kinds nothing --minutes 0.1
    # `timeout` ends its whole group; every line of the log is one whole run
    run matrix on "$where" timeout -k 5 $((end - SECONDS > 0 ? end - SECONDS : 1)) "${blind[@]}" \
        --jobs "$2"
    echo "matrix: $(wc -l <"$out/hidden_effects.jsonl") runs in the log"
    unset OMP_NUM_THREADS
}

pack() { # without networks, and without examples that no page shows; whole at any moment
    local to=${PACK:-$out.tar.gz}
    tar czf "$to.part" --exclude='*.pt' --exclude='*.safetensors' --exclude='real-moments-*/examples.npz' \
        --exclude='*-wgan*/examples.npz' -C "$out" . && mv "$to.part" "$to"
}

for step in "${steps[@]}"; do
    case $step in
    tests) run tests "$python" -m pytest -q -p no:cacheprovider --device "$first" \
        tests/{kernels,effects,probes} tests/fitting/test_descent.py \
        tests/simulation/test_{readout_chain,labels}.py \
        tests/scenes/test_{scenes,between_frames,static,video}.py \
        tests/learning/test_{critic_bank,learned_sensor,training_run}.py ;;
    kernels)
        run kernels_4k "$python" -m perf.benchmarks.kernels --device cuda --size 3840x2160
        run kernels_vga "$python" -m perf.benchmarks.kernels --device cuda --size 640x480 ;;
    synth) for jobs in 1 8; do
        run "synth_$jobs" "$python" -m perf.benchmarks.synth --images "${PHOTOS:-builtin}" --device cuda \
            --jobs "$jobs"
    done ;;
    scaling) run scaling "$python" -m perf.benchmarks.scaling --device cuda --out "$out/docs" ;;
    both)
        learning "${LIMIT:-560}" "0-$((room - 1))" &
        matrix "${LIMIT:-560}" $((cores - room)) "$room-$((cores - 1))"
        wait ;;
    learning) learning "${LIMIT:-560}" ;;
    matrix) matrix "${REST:-240}" $((cores > 4 ? cores - 2 : cores)) ;;
    training) run training "$python" -m perf.benchmarks.training --device "$first" \
        --images "${PHOTOS:-builtin}" --commit "$commit" --out "$out/training.json" ;;
    v2e) for name in v2e_cold v2e; do # the first compiles
        [ -z "${HIDDEN:-}" ] || run $name "$python" -m perf.experiments.blind_diagnosis.run --kinds other --hidden "$HIDDEN" \
            --device "$first" --jobs 1 --log "$out/$name.jsonl"
    done ;;
    *) echo "there is no step '$step'" && exit 2 ;;
    esac
    pack
done
