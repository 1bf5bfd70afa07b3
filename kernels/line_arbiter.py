"""Events of pixels that wait, held, until their row is read."""

from __future__ import annotations

import warp as wp

END = 2**62
"""A time that never comes [ps]."""

NEVER = -END
"""A time that always was [ps]."""

LAST, FREED, DUE, INTERVAL = 0, 1, 2, 3
"""Columns of the times of a pixel: its last event, when it was let go, when its late request comes, from the
event before to the last one where both had one polarity, else 0 [ps]."""

STATUS, LAST_POLARITY, POLARITY, LABEL = 0, 1, 2, 3
"""Columns of the flags of a pixel."""

FREE, FIRST_LINE, QUEUED, HEAPED, LAST_OTHER, GHOSTS, OTHERS, SENT = range(8)
"""Places of single numbers that an arbiter remembers."""

RECENT = 64
"""Requests of others whose lines are remembered, a power of 2."""


@wp.func_native(
    """
    const long long END = 1ll << 62;
    const long long LONGEST_GAP = 100000000ll;  // [ps] others' requests that stand for several spread over it
    long long* const pixel_time = times.data;
    unsigned char* const flag = flags.data;
    long long* const bits = waiting.data;
    long long* const since = line_since.data;
    int* const many_in = line_count.data;
    int* const queue = line_queue.data;
    long long* const heap_at = heap_due.data;
    int* const heap_who = heap_what.data;
    long long* const number = numbers.data;
    const int lines = line_count.shape[0];
    const int words = waiting.shape[1];
    const int room = heap_due.shape[0];
    long long free = number[0];
    int first = (int)number[1], queued = (int)number[2], heaped = (int)number[3];
    long long last_other = number[4], ghosts = number[5], other_requests = number[6];
    int out = 0;

    auto into_line = [&](int line, long long t) {
        if (many_in[line]++ == 0) {
            since[line] = t;
            queue[(first + queued++) % lines] = line;
        }
    };
    auto sooner = [&](long long t, int who, int at) {
        return t < heap_at[at] || (t == heap_at[at] && who < heap_who[at]);
    };
    auto push_heap = [&](long long t, int who) {
        int at = heaped++;
        while (at > 0 && sooner(t, who, (at - 1) / 2)) {
            heap_at[at] = heap_at[(at - 1) / 2];
            heap_who[at] = heap_who[(at - 1) / 2];
            at = (at - 1) / 2;
        }
        heap_at[at] = t;
        heap_who[at] = who;
    };
    auto pop_heap = [&]() {
        const long long t = heap_at[--heaped];
        const int who = heap_who[heaped];
        int at = 0;
        for (;;) {
            int below = 2 * at + 1;
            if (below >= heaped) break;
            if (below + 1 < heaped && sooner(heap_at[below + 1], heap_who[below + 1], below)) ++below;
            if (sooner(t, who, below)) break;
            heap_at[at] = heap_at[below];
            heap_who[at] = heap_who[below];
            at = below;
        }
        heap_at[at] = t;
        heap_who[at] = who;
    };
    auto request = [&](int pixel, long long t) {
        unsigned char* const mine = flag + 4 * (size_t)pixel;
        const int line = pixel / across;
        if (is_other.data[pixel]) {
            // the golden ratio, so that any run of numbers is spread evenly: whole, right in the mean
            const long long many =
                (weight.data[mine[2]] + ((other_requests++ * 2654435769ll) & 0xffffffffll)) >> 32;
            if (many == 0) {
                mine[0] = 0;
                return;
            }
            // what it stands for beside itself asks in lines that others asked in lately, soon after it
            long long gap = t - last_other;
            if (gap > LONGEST_GAP) gap = LONGEST_GAP;
            last_other = t;
            recent.data[other_requests % 64] = line;
            const long long known = other_requests < 64 ? other_requests : 64;
            for (long long k = 1; k < many; ++k) {
                const unsigned int drawn = (unsigned int)(++ghosts * 2654435769ll) >> 8;
                const int there = recent.data[(other_requests - drawn % known) & 63];
                if (heaped < room) push_heap(t + gap * k / many, -1 - there);
                else into_line(there, t);
            }
        }
        mine[0] = 2;
        bits[(size_t)line * words + (pixel % across) / 64] |= 1ll << ((pixel % across) % 64);
        into_line(line, t);
    };
    // time from an event until the light has gone on by the share held / interval of a threshold, on the
    // parabola through the last three events [ps]; END where it turns before. Events that no parabola goes
    // through, as of noise, are taken to go on as they did.
    auto until_share = [&](long long held, long long interval, long long one_before) {
        const double second = (double)interval;
        if (one_before <= 0 || second > 2.414 * (double)one_before) return held;
        const double share = (double)held / second;
        const double first = (double)one_before / second;  // in units of the last interval
        const double bend = (1.0 / first - 1.0) / (0.5 * (first + 1.0));
        const double lost = 0.5 * bend;
        const double speed = 1.0 - lost;
        const double square = speed * speed;
        const double needs = 2.0 * bend;
        const double all = needs * share;
        if (speed <= 0.0 || square < all) return END;
        const double root = sqrt(square - all);
        const double ratio = 2.0 * share / (speed + root);
        return (long long)(ratio * second);
    };
    auto arrive = [&](int pixel, long long t, unsigned char polarity, unsigned char label) {
        unsigned char* const mine = flag + 4 * (size_t)pixel;
        long long* const my_time = pixel_time + 4 * (size_t)pixel;
        const long long before = my_time[0], freed = my_time[1];
        const bool goes_on = before > -END && mine[1] == polarity;
        const long long interval = goes_on ? t - before : 0, one_before = my_time[3];
        my_time[0] = t;
        my_time[3] = interval;
        mine[1] = polarity;
        if (mine[0] == 2 || t < freed) return;  // held: it sees nothing
        if (mine[0] == 1) {
            // the light has gone on beyond the next threshold, or turned back before it
            mine[0] = 0;
            if (mine[2] == polarity) request(pixel, t);
            return;
        }
        mine[2] = polarity;
        mine[3] = label;
        // let go a share of an interval after the event before, it asks that share of a threshold later
        const long long held = goes_on && freed > before ? freed - before : 0;
        const long long late = held > 0 ? until_share(held, interval, one_before) : 0;
        if (late == 0) {
            request(pixel, t);
        } else {
            mine[0] = 1;
            my_time[2] = late == END ? END : t + late;
            if (late == END) return;  // it asks if the light goes on beyond its next event after all
            if (heaped < room) push_heap(t + late, pixel);
            else request(pixel, t);
        }
    };

    int i = 0, j = 0;
    const int count = arrival.shape[0], others = other.shape[0];
    for (;;) {
        // a request that was taken back leaves its place in the heap
        while (heaped > 0 && heap_who[0] >= 0 &&
               (flag[4 * (size_t)heap_who[0]] != 1 || pixel_time[4 * (size_t)heap_who[0] + 2] != heap_at[0]))
            pop_heap();
        const long long raw_t = i < count ? arrival.data[i] : END;
        const long long other_t = j < others ? other.data[j] : END;
        const long long due_t = heaped > 0 ? heap_at[0] : END;
        const long long next = raw_t < other_t ? raw_t : other_t;
        const long long ask = due_t <= next ? due_t : next;
        if (queued > 0) {
            const int line = queue[first];
            const long long begin = free > since[line] ? free : since[line];
            // requests of that very moment are in it
            if (begin < ask) {
                if (begin >= until) break;
                const long long end = begin + per_line + (long long)many_in[line] * per_event;
                const long long whole = begin / 1000 - (begin % 1000 < 0);
                for (int w = 0; w < words; ++w) {
                    unsigned long long left = (unsigned long long)bits[(size_t)line * words + w];
                    if (left == 0) continue;
                    bits[(size_t)line * words + w] = 0;
                    for (; left != 0; left &= left - 1) {
                        const int pixel = line * across + 64 * w + __builtin_ctzll(left);
                        unsigned char* const mine = flag + 4 * (size_t)pixel;
                        mine[0] = 0;
                        pixel_time[4 * (size_t)pixel + 1] = end;
                        if (is_other.data[pixel]) continue;
                        out_time.data[out] = 1e-9 * (double)whole;
                        out_pixel.data[out] = pixel;
                        out_polarity.data[out] = mine[2];
                        out_label.data[out++] = (signed char)mine[3];
                    }
                }
                many_in[line] = 0;
                first = (first + 1) % lines;
                --queued;
                free = end;
                continue;
            }
        }
        if (ask == END) break;
        if (due_t <= next) {
            if (next == END && due_t >= until) break;
            const int who = heap_who[0];
            pop_heap();
            if (who < 0) into_line(-1 - who, due_t);
            else request(who, due_t);
        } else if (raw_t <= other_t) {
            arrive(place.data[i], raw_t, polarity.data[i], (unsigned char)label.data[i]);
            ++i;
        } else {
            arrive(other_place.data[j], other_t, other_polarity.data[j], 0);
            ++j;
        }
    }
    number[0] = free;
    number[1] = first;
    number[2] = queued;
    number[3] = heaped;
    number[4] = last_other;
    number[5] = ghosts;
    number[6] = other_requests;
    number[7] = out;
"""
)
def arbitrate(
    arrival: wp.array[wp.int64],
    place: wp.array[int],
    polarity: wp.array[wp.uint8],
    label: wp.array[wp.int8],
    other: wp.array[wp.int64],
    other_place: wp.array[int],
    other_polarity: wp.array[wp.uint8],
    weight: wp.array[wp.int64],
    until: wp.int64,
    across: int,
    per_line: wp.int64,
    per_event: wp.int64,
    is_other: wp.array[wp.uint8],
    times: wp.array2d[wp.int64],
    flags: wp.array2d[wp.uint8],
    waiting: wp.array2d[wp.int64],
    line_since: wp.array[wp.int64],
    line_count: wp.array[int],
    line_queue: wp.array[int],
    heap_due: wp.array[wp.int64],
    heap_what: wp.array[int],
    recent: wp.array[int],
    numbers: wp.array[wp.int64],
    out_time: wp.array[wp.float64],
    out_pixel: wp.array[int],
    out_polarity: wp.array[wp.uint8],
    out_label: wp.array[wp.int8],
):
    """Do what `send_by_lines` does; arguments have the shape and unit that it says."""
    ...


@wp.kernel(enable_backward=False)
def send_by_lines(
    # in
    arrival: wp.array[wp.int64],  # (N,) [ps], not decreasing
    place: wp.array[int],  # (N,) pixel, line after line
    polarity: wp.array[wp.uint8],  # (N,) 1 for ON
    label: wp.array[wp.int8],  # (N,)
    other: wp.array[wp.int64],  # (M,) [ps], not decreasing: events that take room and time and are not sent
    other_place: wp.array[int],  # (M,) of those
    other_polarity: wp.array[wp.uint8],  # (M,) of those
    weight: wp.array[wp.int64],  # (2,) how many events one of those stands for, times ONE, by polarity
    until: wp.int64,  # nothing is read from here on while later requests may come [ps]
    across: int,  # pixels of a line
    per_line: wp.int64,  # time to take a line [ps]
    per_event: wp.int64,  # time to send one event of it [ps]
    is_other: wp.array[wp.uint8],  # (lines * across,)
    # in and out
    times: wp.array2d[wp.int64],  # (lines * across, 4) LAST, FREED, DUE, INTERVAL [ps]
    flags: wp.array2d[wp.uint8],  # (lines * across, 4) STATUS (1 late, 2 waiting) and so on
    waiting: wp.array2d[wp.int64],  # (lines, words) bit of each pixel that waits
    line_since: wp.array[wp.int64],  # (lines,) first request of a line [ps]
    line_count: wp.array[int],  # (lines,) requests of a line
    line_queue: wp.array[int],  # (lines,) ring of lines with requests, in order of their first
    heap_due: wp.array[wp.int64],  # (K,) [ps] a heap: the children of k are 2 k + 1 and 2 k + 2
    heap_what: wp.array[int],  # (K,) pixel, or -1 - line for a request of no pixel of its own
    recent: wp.array[int],  # (RECENT,) lines of the last others' requests
    numbers: wp.array[wp.int64],  # (8,) FREE and so on
    # out
    out_time: wp.array[wp.float64],  # (L,) when the line was taken [s], in whole nanoseconds
    out_pixel: wp.array[int],  # (L,)
    out_polarity: wp.array[wp.uint8],  # (L,)
    out_label: wp.array[wp.int8],  # (L,)
):
    """Read lines in the order of their first requests, on one thread.

    Who waits depends on all that was read before, so this is no scan. Times are whole picoseconds of 64 bits.
    """
    arbitrate(
        arrival, place, polarity, label, other, other_place, other_polarity, weight, until, across, per_line,
        per_event, is_other, times, flags, waiting, line_since, line_count, line_queue, heap_due, heap_what,
        recent, numbers, out_time, out_pixel, out_polarity, out_label,
    )  # fmt: skip
