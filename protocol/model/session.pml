/* The handshake, the exchange and the end of a session, as sections 2, 4, 5, 8, 9, 10 and 12 of the
 * specification tell them, for spin to search through. README.md says what is modelled and what is not.
 *
 * One configuration is chosen by its name (-DRESTART); a fault may be seeded (-DFAULT_NO_LOCK).
 */

/* --- Configurations ------------------------------------------------------------------------------------- */

#if defined(OBSERVED)        /* steps alone, word by word, under the eyes of an observer */
#define AGENTS 1
#define SERVERS 1
#define REQUESTS 2
#define KILLS 1
#define STOPS 0
#define WORD_BY_WORD
#elif defined(EVERY_REQUEST) /* requests of every kind, done or refused */
#define AGENTS 1
#define SERVERS 1
#define REQUESTS 2
#define KILLS 1
#define STOPS 1
#define ANY_REQUEST
#elif defined(TAKEOVER)      /* a second physics process: a second client, or another in the place of a dead one */
#define AGENTS 1
#define SERVERS 2
#define REQUESTS 1
#define KILLS 2
#define STOPS 0
#elif defined(RESTART)       /* a second agent of the same name, and a physics process that may meet both */
#define AGENTS 2
#define SERVERS 1
#define REQUESTS 1
#define KILLS 2
#define STOPS 0
#elif defined(WAITING)       /* every wait ends: liveness */
#define AGENTS 1
#define SERVERS 2
#define REQUESTS 1
#define KILLS 1
#define STOPS 0
#elif defined(ROGUE)         /* one side breaks the protocol, in one of many ways */
#define AGENTS 1
#define SERVERS 1
#define REQUESTS 2
#define KILLS 0
#define STOPS 0
#define ANY_REQUEST
#define WORD_BY_WORD
#elif defined(CROWD)         /* two agents and two physics processes; for a large memory */
#define AGENTS 2
#define SERVERS 2
#define REQUESTS 0
#define KILLS 1
#define STOPS 0
#else
#error choose a configuration: -DOBSERVED, -DEVERY_REQUEST, -DTAKEOVER, -DRESTART, -DWAITING, -DROGUE or -DCROWD
#endif

#define PROCESSES (AGENTS + SERVERS) /* processes 0 to AGENTS - 1 are agents, the others physics */
#define NONE 15

#if PROCESSES == 2
#define ALL_GONE !alive[0] && !alive[1]
#define NOBODY_HAS(i) has[0] != i && has[1] != i
#elif PROCESSES == 3
#define ALL_GONE !alive[0] && !alive[1] && !alive[2]
#define NOBODY_HAS(i) has[0] != i && has[1] != i && has[2] != i
#else
#define ALL_GONE !alive[0] && !alive[1] && !alive[2] && !alive[3]
#define NOBODY_HAS(i) has[0] != i && has[1] != i && has[2] != i && has[3] != i
#endif

#include "states.pml"
#include "system.pml"
#include "message.pml"
#include "agent.pml"
#include "physics.pml"

/* --- An observer ---------------------------------------------------------------------------------------- */

#ifdef OBSERVED
/* Reads one message at any moment, and writes nothing. */
proctype Observer() {
    byte first, second, begin, end_;
    mtype kind;
    if
    :: end_ = cmd[0].end; first = cmd[0].first; second = cmd[0].second; begin = cmd[0].begin;
        assert(begin != end_ || first == end_ && second == end_)
    :: end_ = pose[0].end; first = pose[0].first; second = pose[0].second; kind = pose[0].kind; begin = pose[0].begin;
        assert(begin != end_ || first == second && (first == end_ || first < end_ && kind == REFUSED))
    fi;
    d_step { first = 0; second = 0; begin = 0; end_ = 0; kind = 0 }
}
#endif

/* --- All together --------------------------------------------------------------------------------------- */

init {
    byte i;
    atomic {
#ifdef ROGUE
        if :: liar = 0 :: liar = AGENTS fi;
#endif
#ifdef WAITING
        do :: watched < PROCESSES - 1 -> watched++ :: break od;
#endif
        do
        :: i < AGENTS -> run Agent(i); i++
        :: i >= AGENTS && i < PROCESSES -> run Physics(i); i++
        :: else -> break
        od;
#ifdef OBSERVED
        run Observer();
#endif
        run Fate();
        i = 0
    };
    ALL_GONE;
    /* Whatever stands now was last used by a process that was killed. */
    assert((cmd_name == NONE || killed_last[cmd_name]) && (pose_name == NONE || killed_last[pose_name]))
}

#ifdef WAITING
/* Every wait for the other side's doorbell ends (under weak fairness: whoever can always act, acts). */
ltl waits_end { [] (waits[watched] -> <> !waits[watched]) }
#endif
