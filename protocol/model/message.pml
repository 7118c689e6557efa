/* Requests, replies and farewells, as they are written and read. */

/* What a peer that breaks the protocol may do, once. */
mtype = { TORN, WRONG_NUMBER, WRONG_STEP, UNKNOWN, TOO_SOON };
#ifdef ROGUE
byte liar;
#define LIAR (liar == me)
#define PEER_LIES (liar != me)
#else
#define LIAR false
#define PEER_LIES false
#endif

inline perhaps_lie(another) {
#ifdef ROGUE
    if
    :: !LIAR
    :: LIAR && number < REQUESTS
    :: LIAR -> lie = TORN
    :: LIAR -> lie = WRONG_NUMBER
    :: LIAR -> lie = WRONG_STEP
    :: LIAR -> lie = UNKNOWN
    :: LIAR -> lie = another
    fi
#else
    skip
#endif
}

/* Each word is a store of its own where it matters; elsewhere the words between `begin` and the doorbell are one. */
#ifdef WORD_BY_WORD
#define WORDS
#else
#define WORDS atomic
#endif

inline publish(segment, payload, said, count) {
#ifdef FAULT_DOORBELL_FIRST
    segment.bell = number;
#endif
#ifndef FAULT_BEGIN_LAST
    segment.begin = number;
#else
    segment.end = number;
#endif
    WORDS {
        segment.first = payload;
        segment.second = payload;
        segment.kind = (lie == UNKNOWN -> OFFER : said);
        segment.step = (lie == WRONG_STEP -> count + 1 : count);
#ifndef FAULT_BEGIN_LAST
        segment.end = (lie == TORN -> number - 1 : number)
#else
        segment.begin = number
#endif
    };
#ifndef FAULT_DOORBELL_FIRST
    segment.bell = (lie == WRONG_NUMBER -> number + 1 : number)
#endif
}

inline take(segment) {
    WORDS {
        rung = segment.bell;
        first = segment.first;
        second = segment.second;
        begin = segment.begin;
        kind = segment.kind;
        step = segment.step;
        end_ = segment.end
    }
}

inline forget() { rung = 0; first = 0; second = 0; begin = 0; kind = 0; step = 0; end_ = 0; what = 0 }

/* The word of a farewell stands: so does its text. */
#define SAID_WHY(segment) what = FAREWELL; assert(segment.text)

inline say_farewell(segment) {
    WORDS {
        segment.text = true;
        segment.farewell = true
    }
}
