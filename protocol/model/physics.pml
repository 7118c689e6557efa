/* The physics process: finds a session, claims it, answers. */

proctype Physics(byte me) {
    mtype state = OFFERED, what, kind, lie, verdict;
    byte at = NONE, mine = NONE, number, steps, shown, rung, first, second, begin, step, end_;
  {
    skip;
attach:
    if
    :: atomic { cmd_name != NONE -> at = cmd_name; has[me] = at }
    :: goto out                       /* its deadline, its launcher's death, told to stop */
    fi;
    if
    :: cmd[at].magic
    :: !cmd[at].magic -> goto again       /* it is being written */
    :: !cmd[at].magic -> goto abandoned   /* and that for half a second */
    fi;
    if
    :: !alive[cmd[at].owner] -> goto abandoned
    :: alive[cmd[at].owner] && cmd[at].farewell -> goto again
    :: else
    fi;
    atomic { if :: pose_name == NONE -> goto again :: else -> mine = pose_name fi };
#ifndef FAULT_NO_NAME_CHECK
    if
    :: cmd_name == at
    :: else -> goto again             /* the pose segment may be a newer session's */
    fi;
#endif
    if
    :: atomic { pose[mine].lock == NONE -> pose[mine].lock = me }
#ifndef FAULT_NO_LOCK
    :: else -> goto out               /* a second client */
#else
    :: else
#endif
    fi;
#ifndef FAULT_SERVED_TWICE
    if
    :: pose[mine].magic || pose[mine].farewell -> goto out
    :: else
    fi;
#endif
    atomic {
        assert(cmd[at].session == at);
        if
        :: told[me] -> what = FAREWELL; goto leave_broken
        :: cmd[at].bell != 0 -> what = VIOLATION; goto leave_broken
        :: else
        fi
    };
#ifdef ROGUE
    if
    :: LIAR -> pose[mine].bell = 1; lie = TOO_SOON
    :: true
    fi;
#endif
    pose[mine].owner = me;
    pose[mine].session = at;
    atomic { assert(!pose[mine].magic); pose[mine].magic = true; what = ATTACH; attached() };

idle:
#ifdef ROGUE
    if
    :: lie != 0 -> goto await_end
    :: LIAR && lie == 0 -> pose[mine].bell = number + 1; goto await_end
    :: lie == 0
    fi;
#endif
    atomic { forget(); waits[me] = true };
    do
    :: cmd[at].bell != number -> goto rang
    :: atomic { cmd[at].farewell -> SAID_WHY(cmd[at]); break }
#ifndef FAULT_NO_LIVENESS
    :: atomic { !alive[cmd[at].owner] -> what = LOSS; break }
#endif
    :: atomic { told[me] -> what = FAREWELL; goto leave_broken }
    od;
#ifndef FAULT_NO_LAST_LOOK
    if
    :: cmd[at].bell != number         /* it rang before it ended */
    :: else -> goto leave_broken
    fi;
#else
    goto leave_broken;
#endif
rang:
    take(cmd[at]);
    atomic {
        waits[me] = false;
        if
#ifdef FAULT_NO_STEP_CHECK
        :: rung == number + 1 && begin == rung && end_ == rung && kind != OFFER ->
#else
        :: rung == number + 1 && begin == rung && end_ == rung &&
                (kind == STEP && step == steps + 1 || kind != STEP && kind != OFFER && step == steps) ->
#endif
            assert(first == rung && second == rung)
        :: else -> what = VIOLATION; goto leave_broken
        fi;
        number++;
        what = kind;
        asked();
        if
        :: told[me] -> what = FAREWELL; goto leave_broken
        :: else
        fi;
        verdict = DONE;
        if
#ifdef ANY_REQUEST
        :: kind != GOODBYE -> verdict = REFUSED
#endif
        :: kind == STEP -> steps++; integrated[at]++; assert(integrated[at] == step && steps == step); shown = number
        :: kind != STEP -> shown = number
        fi;
        forget()
    };
    atomic {
        if
        :: cmd[at].bell != number || cmd[at].begin != number -> what = VIOLATION; goto leave_broken
        :: else
        fi;
        perhaps_lie(TORN);
        assert(cmd[at].bell == pose[mine].bell + 1 && pose[mine].lock == me) /* our turn, and ours to write */
    };
    publish(pose[mine], shown, verdict, steps);
    atomic {
        what = verdict;
        verdict = 0;
        answered();
        if
        :: state == READY -> goto idle
        :: else -> goto leave
        fi
    };
await_end:
    do
    :: atomic { cmd[at].farewell -> what = FAREWELL; break }
    :: atomic { !alive[cmd[at].owner] -> what = LOSS; break }
    od;
leave_broken:
    atomic {
        assert(PEER_LIES || what != VIOLATION);
        assert(what != LOSS || cmd[at].bell == number || PEER_LIES || LIAR); /* its last word counted */
        waits[me] = false;
        broken();
        forget()
    };
    say_farewell(pose[mine]);
leave:
    if
#ifndef FAULT_NO_REMOVAL
    :: !alive[cmd[at].owner] -> remove_dead(at)
    :: atomic { alive[cmd[at].owner] -> killed_last[at] = false; has[me] = NONE }
#else
    :: atomic { killed_last[at] = false; has[me] = NONE }
#endif
    fi;
    goto out;
abandoned:
    remove_dead(at);
again:                                /* what was there is not, or not yet, for us */
    atomic { let_go(me, at); mine = NONE; at = NONE };
    goto attach;
out:
    gone(me, at)
  } unless {
    d_step {
        !alive[me] -> forget(); state = 0; lie = 0; verdict = 0; at = 0; mine = 0; number = 0; steps = 0; shown = 0
    }
  }
}
