"""Events of pixels that wait, held, until their row is read."""

from __future__ import annotations

from enum import IntEnum

import warp as wp

END = 2**62
"""A time that never comes [ps]."""

NEVER = -END
"""A time that always was [ps]."""


class PixelColumn(IntEnum):
    """What is known of a pixel, [ps] but for the last column, whose bytes `arbitrate` names."""

    LAST = 0
    """Its last event."""

    FREED = 1
    """When it was let go."""

    INTERVAL = 2
    """From the event before to the last one where both had one polarity, else 0."""


class PixelByte(IntEnum):
    """Bytes of a pixel that are set from outside."""

    OTHER = 31
    """1 where its events are not sent."""


class ArbiterNumber(IntEnum):
    """Places of single numbers that an arbiter remembers, in the order of `arbitrate`."""

    FREE = 0
    """When the bus is free [ps]."""

    FIRST_LINE = 1
    QUEUED = 2
    HEAPED = 3
    LAST_OTHER = 4
    GHOSTS = 5
    OTHERS = 6

    SENT = 7
    """Events that the last call wrote."""

    HELD = 8
    """Pixels of the recording that wait or will ask late."""


RECENT = 64
"""Requests of others whose lines are remembered, a power of 2."""


@wp.func_native(
    """
    const long long END = 1ll << 62;
    const int AHEAD = 16;  // events whose pixels are on their way from memory
    const long long LONGEST_GAP = 100000000ll;  // [ps] others' requests that stand for several spread over it
    // half a cache line for all that an event needs to know
    struct Pixel {
        long long last, freed, interval;  // [ps]
        unsigned char status;  // 1: asks late, 2: waits
        unsigned char last_polarity, polarity, label;
        unsigned short turn;  // of the late requests
        unsigned char spare, other;
    };
    static_assert(sizeof(Pixel) == 32, "a pixel is four numbers of 64 bits");
    Pixel* const pixels = (Pixel*)known.data;
    const int mask = (1 << shift) - 1;
    long long* const bits = waiting.data;
    long long* const since = line_since.data;
    int* const many_in = line_count.data;
    int* const queue = line_queue.data;
    long long* const heap_at = heap_due.data;
    long long* const heap_who = heap_what.data;
    long long* const number = numbers.data;
    const int lines = line_count.shape[0];
    const int words = waiting.shape[1];
    const int room = heap_due.shape[0];
    long long free = number[0];
    int first = (int)number[1], queued = (int)number[2], heaped = (int)number[3];
    long long last_other = number[4], ghosts = number[5], other_requests = number[6];
    long long held_pixels = number[8];
    int out = 0;

    long long soonest = 0;  // when anybody else may ask
    auto into_line = [&](int line, long long t) {
        if (many_in[line]++ == 0) {
            since[line] = t;
            queue[(first + queued++) % lines] = line;
        }
    };
    auto sooner = [&](long long t, long long who, int at) {
        return t < heap_at[at] || (t == heap_at[at] && who < heap_who[at]);
    };
    auto push_heap = [&](long long t, long long who) {
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
        const long long who = heap_who[heaped];
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
        Pixel& mine = pixels[pixel];
        const int line = pixel >> shift;
        if (mine.other) {
            // the golden ratio, so that any run of numbers is spread evenly: whole, right in the mean
            const long long many =
                (weight.data[mine.polarity] + ((other_requests++ * 2654435769ll) & 0xffffffffll)) >> 32;
            if (many == 0) {
                mine.status = 0;
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
        if (queued == 0 && free <= t && t < soonest) {
            // most often nobody else asks: it is read at once
            const long long whole = t / 1000 - (t % 1000 < 0);
            free = t + per_line + per_event;
            mine.status = 0;
            mine.freed = free;
            if (mine.other) return;
            --held_pixels;
            out_time.data[out] = 1e-9 * (double)whole;
            out_pixel.data[out] = pixel;
            out_polarity.data[out] = mine.polarity;
            out_label.data[out++] = (signed char)mine.label;
            return;
        }
        mine.status = 2;
        bits[(size_t)line * words + (pixel & mask) / 64] |= 1ll << (pixel & mask & 63);
        into_line(line, t);
    };
    // time from an event until the light has gone on by the share held / interval of a threshold, on the
    // parabola through the last three events [ps]; END where it turns before. Events that no parabola goes
    // through, as of noise, are taken to go on as they did.
    auto until_share = [&](long long held, long long interval, long long one_before) -> long long {
        const double second = (double)interval;
        if (1000 * held < interval) return 0;  // not worth a place in the heap
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
        Pixel& mine = pixels[pixel];
        const long long before = mine.last;
        const bool goes_on = before > -END && mine.last_polarity == polarity;
        const long long interval = goes_on ? t - before : 0, one_before = mine.interval;
        mine.last = t;
        mine.interval = interval;
        mine.last_polarity = polarity;
        if (mine.status == 2 || t < mine.freed) return;  // held: it sees nothing
        if (mine.status == 1) {
            // the light has gone on beyond the next threshold, or turned back before it
            if (mine.polarity == polarity) {
                request(pixel, t);
            } else {
                mine.status = 0;
                held_pixels -= !mine.other;
            }
            return;
        }
        held_pixels += !mine.other;
        mine.polarity = polarity;
        mine.label = label;
        // let go a share of an interval after the event before, it asks that share of a threshold later
        const long long held = goes_on && mine.freed > before ? mine.freed - before : 0;
        const long long late = held > 0 ? until_share(held, interval, one_before) : 0;
        if (late == 0 || (late < END && heaped >= room)) {
            request(pixel, t);
            return;
        }
        mine.status = 1;
        ++mine.turn;
        // where the light turns before, it asks only if it goes on beyond its next event after all
        if (late < END) push_heap(t + late, pixel | (long long)mine.turn << 32);
    };

    int i = 0, j = 0;
    const int count = arrival.shape[0], others = other.shape[0];
    for (;;) {
        // a request that was taken back leaves its place in the heap
        while (heaped > 0 && heap_who[0] >= 0) {
            const Pixel& mine = pixels[heap_who[0] & 0xffffffffll];
            if (mine.status == 1 && mine.turn == (heap_who[0] >> 32)) break;
            pop_heap();
        }
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
                        const int pixel = (line << shift) + 64 * w + __builtin_ctzll(left);
                        Pixel& mine = pixels[pixel];
                        mine.status = 0;
                        mine.freed = end;
                        if (mine.other) continue;
                        --held_pixels;
                        out_time.data[out] = 1e-9 * (double)whole;
                        out_pixel.data[out] = pixel;
                        out_polarity.data[out] = mine.polarity;
                        out_label.data[out++] = (signed char)mine.label;
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
            const long long who = heap_who[0];
            pop_heap();
            soonest = next < until ? next : until;
            if (heaped > 0 && heap_at[0] < soonest) soonest = heap_at[0];
            if (who < 0) into_line((int)(-1 - who), due_t);
            else request((int)(who & 0xffffffffll), due_t);
            continue;
        }
        const bool mine_first = raw_t <= other_t;
        const int after_i = i + mine_first, after_j = j + !mine_first;
        const long long after_raw = after_i < count ? arrival.data[after_i] : END;
        const long long after_other = after_j < others ? other.data[after_j] : END;
        soonest = after_raw < after_other ? after_raw : after_other;
        if (due_t < soonest) soonest = due_t;
        if (until < soonest) soonest = until;
        if (mine_first) {
            if (i + AHEAD < count) __builtin_prefetch(pixels + place.data[i + AHEAD], 1);
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
    number[8] = held_pixels;
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
    shift: int,
    per_line: wp.int64,
    per_event: wp.int64,
    known: wp.array2d[wp.int64],
    waiting: wp.array2d[wp.int64],
    line_since: wp.array[wp.int64],
    line_count: wp.array[int],
    line_queue: wp.array[int],
    heap_due: wp.array[wp.int64],
    heap_what: wp.array[wp.int64],
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
    place: wp.array[int],  # (N,) line * 2**shift + place in the line
    polarity: wp.array[wp.uint8],  # (N,) 1 for ON
    label: wp.array[wp.int8],  # (N,)
    other: wp.array[wp.int64],  # (M,) [ps], not decreasing: events that take room and time and are not sent
    other_place: wp.array[int],  # (M,) of those
    other_polarity: wp.array[wp.uint8],  # (M,) of those
    weight: wp.array[wp.int64],  # (2,) how many events one of those stands for, times ONE, by polarity
    until: wp.int64,  # nothing is read from here on while later requests may come [ps]
    shift: int,  # a line has room for 2**shift pixels
    per_line: wp.int64,  # time to take a line [ps]
    per_event: wp.int64,  # time to send one event of it [ps]
    # in and out
    known: wp.array2d[wp.int64],  # (lines * 2**shift, 4) `PixelColumn`
    waiting: wp.array2d[wp.int64],  # (lines, words) bit of each pixel that waits
    line_since: wp.array[wp.int64],  # (lines,) first request of a line [ps]
    line_count: wp.array[int],  # (lines,) requests of a line
    line_queue: wp.array[int],  # (lines,) ring of lines with requests, in order of their first
    heap_due: wp.array[wp.int64],  # (K,) [ps] a heap: the children of k are 2 k + 1 and 2 k + 2
    heap_what: wp.array[wp.int64],  # (K,) turn * 2**32 + pixel, or -1 - line for a request of no pixel
    recent: wp.array[int],  # (RECENT,) lines of the last others' requests
    numbers: wp.array[wp.int64],  # (9,) `ArbiterNumber`
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
        arrival, place, polarity, label, other, other_place, other_polarity, weight, until, shift, per_line,
        per_event, known, waiting, line_since, line_count, line_queue, heap_due, heap_what, recent, numbers,
        out_time, out_pixel, out_polarity, out_label,
    )  # fmt: skip
