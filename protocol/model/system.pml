/* Shared memory, names, locks, and what befalls a process. */

/* --- What is shared ------------------------------------------------------------------------------------- */

/* A segment. Every store to one of its words is a step of its own, so that a reader meets every half-written
 * state and a kill leaves any of them behind. */
typedef Segment {
    byte owner = NONE;   /* pid and start_time, in one */
    byte session = NONE; /* the rest of the header: whose session it is */
    bool magic;
    bool text;           /* farewell: the text, then the word */
    bool farewell;
    byte begin, first, second, step, end, bell; /* first, second: a payload of two words */
    mtype kind;          /* op of a request, status of a reply */
    byte lock = NONE     /* which process holds the lock on byte 0; the system's, not a word */
};

/* Agent i creates segments of number i, once: the number is the inode. */
Segment cmd[AGENTS], pose[AGENTS];
/* What the names NAME.cmd and NAME.pose stand for. */
byte cmd_name = NONE, pose_name = NONE;

bool alive[PROCESSES] = true;
bool told[PROCESSES];          /* it shall stop: a signal, an engine that fails, a header not to its taste */

/* What nobody sees but the properties. */
bool waits[PROCESSES];         /* it waits for the other side's doorbell */
byte has[PROCESSES] = NONE;    /* session of which a physics process has the segments open */
#ifdef WAITING
byte watched;                  /* the process whose waits shall end */
#endif
byte integrated[AGENTS];       /* control steps, by session */
bool killed_last[AGENTS];      /* the last to have had to do with the session was killed */

/* --- What the system does ------------------------------------------------------------------------------- */

/* A process lets go of the segments that it has open. What nobody has, and no name stands for, is no more:
 * its words are cleared, so that histories which nobody can tell apart count as one. */
inline let_go(who, inode) {
    has[who] = NONE;
    inode = 0;
    do
    :: inode < AGENTS ->
        if
        :: cmd[inode].lock == who -> cmd[inode].lock = NONE
        :: else
        fi;
        if
        :: pose[inode].lock == who -> pose[inode].lock = NONE
        :: else
        fi;
        if
        :: AGENTS > 1 && !alive[inode] && NOBODY_HAS(inode) && cmd_name != inode && pose_name != inode ->
            wipe(cmd[inode]);
            wipe(pose[inode]);
            integrated[inode] = 0;
            killed_last[inode] = false
        :: else
        fi;
        inode++
    :: else -> break
    od;
    inode = 0
}

inline wipe(segment) {
    segment.owner = NONE; segment.session = NONE; segment.magic = false;
    segment.farewell = 0; segment.text = 0;
    segment.begin = 0; segment.first = 0; segment.second = 0; segment.kind = 0;
    segment.step = 0; segment.end = 0; segment.bell = 0
}

inline gone(who, inode) {
    d_step { alive[who] = false; waits[who] = false; told[who] = false; let_go(who, inode) }
}

inline killed(who, inode) {
    inode = 0;
    do
    :: inode < AGENTS ->
        if
        :: who == inode || cmd[inode].lock == who || who >= AGENTS && has[who] == inode -> killed_last[inode] = true
        :: else
        fi;
        inode++
    :: else -> break
    od;
    gone(who, inode)
}

/* Kills (at any moment, that is between any two steps of another process) and asks to stop. */
proctype Fate() {
    byte kills = KILLS, stops = STOPS, who, inode;
    do
    :: atomic { kills + stops > 0 ->
            do
            :: who < PROCESSES - 1 -> who++
            :: break
            od;
            if
            :: kills > 0 && alive[who] -> kills--; killed(who, inode)
            :: stops > 0 && alive[who] && !told[who] -> stops--; told[who] = true
            :: !alive[who]
            fi;
            who = 0 }
    :: atomic { kills = 0; stops = 0; break }
    od
}

/* Remove a session's names: in steps between which others act. It takes the lock on `.cmd`, under which nobody
 * else puts newer names there, and `.pose` goes first, so that it never stands alone. */
inline remove_names(inode) {
    if
#ifndef FAULT_UNLINK_BLIND
    :: cmd_name == inode ->
#else
    :: true ->
#endif
#ifdef FAULT_COMMAND_REMOVED_FIRST
        unlink(cmd_name, inode);
#endif
        unlink(pose_name, inode);
#ifndef FAULT_COMMAND_REMOVED_FIRST
        unlink(cmd_name, inode)
#endif
    :: else                           /* it stands for a newer segment, or for none: another was quicker */
    fi
}

/* Nobody but the living agent itself removes its names, once it has locked them; and none removes another's. */
inline unlink(name, inode) {
    atomic {
        assert(inode == me || !alive[inode] || cmd[inode].lock != inode);
        assert(name == inode || name == NONE);
        name = NONE
    }
}

/* Remove a dead agent's names, if nobody else is at it. */
inline remove_dead(inode) {
    if
#ifndef FAULT_REMOVED_UNLOCKED
    :: atomic { cmd[inode].lock == NONE -> cmd[inode].lock = me };
#else
    :: true ->
#endif
        remove_names(inode);
        d_step {
            killed_last[inode] = false;
            if
            :: cmd[inode].lock == me -> cmd[inode].lock = NONE
            :: else
            fi
        }
    :: else
    fi
}
