// Put this component on one object of a scene, give it a rendezvous, press Play: it serves the drone's physics to the
// agent. README.md tells how, step by step.

using System;
using System.Diagnostics;
using System.Threading;
using UnityEngine;
using Debug = UnityEngine.Debug;

namespace TubeCosim
{
    public sealed class UnityPhysicsServer : MonoBehaviour
    {
        [Tooltip("shm:NAME or file:/path/stem; empty: the last argument of the command line")]
        public string rendezvous = "";

        [Tooltip("a tube of the scene, with MeshColliders that are not convex; empty: the registered .obj file")]
        public GameObject sceneTube;

        [Tooltip("how much of a frame may go to the agent's requests (ms); a step that is under way is finished")]
        public float frameBudgetMs = 8f;

        [Tooltip("serve the next session when one is over; else a player that runs in batch mode quits")]
        public bool serveAgain = true;

        [Tooltip("largest speed that a command may carry (m/s)")]
        public double speedMax = 10.0;

        // The plant's default parameters by Layout.ParameterIndex: those of physics_server, so that it flies the same.
        private static readonly double[] Defaults =
        {
            1.0, 0.004, 0.004, 0.004, 0.15, // mass, inertia, body radius
            8.0, 0.0, 120.0, 18.0, // gains of force and torque
            0.0, 0.0, 9.81, // drag, gravity
            0.3, 0.5, // restitution, friction
            0.0, 0.0, 0.0, 0.0, // disturbance, gust
        };

        private const float PauseS = 1f; // between two sessions
        private const double AttachTimeoutS = 30.0; // for a player that serves one session
        private const double QuietMs = 50.0;

        private readonly Stopwatch clock = Stopwatch.StartNew();
        private PhysicsPeer peer; // null between two sessions
        private double openAt, answeredAt;

        private void Start()
        {
            Application.runInBackground = true; // else Unity stands still behind other windows
            string[] arguments = Environment.GetCommandLineArgs();
            if (string.IsNullOrEmpty(rendezvous))
                rendezvous = arguments[arguments.Length - 1];
        }

        private void Update()
        {
            try
            {
                double now = clock.Elapsed.TotalSeconds;
                if (peer == null && now >= openAt)
                    peer = new PhysicsPeer(rendezvous, new UnityPlant(speedMax, Defaults, sceneTube));
                if (peer == null)
                    return;
                if (!peer.TryAttach())
                    EndIfNobodyComes(now);
                else if (AnswerForAWhile() == Turn.Closed)
                    End("the agent said goodbye after " + Format.Of(peer.Steps) + " steps");
            }
            catch (ProtocolException error)
            {
                Debug.LogError("TubeCosim: " + error.Message);
                End("the session is over");
            }
            catch (Exception error)
            {
                Debug.LogException(error);
                End("the session is over");
            }
        }

        private void OnDestroy()
        {
            if (peer != null)
                peer.Stop("Unity has left Play mode or quits");
        }

        // Answers what the agent asks until the frame's budget is used up. Waits for more within that budget while the
        // agent is at work; looks once a frame where it has asked for nothing lately.
        private Turn AnswerForAWhile()
        {
            double began = clock.Elapsed.TotalMilliseconds, now = began;
            Turn turn;
            do
            {
                turn = peer.TryAnswer();
                now = clock.Elapsed.TotalMilliseconds;
                if (turn == Turn.Answered)
                    answeredAt = now;
                else if (now - answeredAt > QuietMs)
                    break;
                else
                    Thread.Yield();
            } while (turn != Turn.Closed && now - began < frameBudgetMs);
            return turn;
        }

        private void EndIfNobodyComes(double now)
        {
            if (!serveAgain && now > AttachTimeoutS)
                End("no session at " + rendezvous + " within " + Format.Of(AttachTimeoutS) + " s, found " + peer.News);
        }

        private void End(string how)
        {
            Debug.Log("TubeCosim: " + how);
            if (peer != null)
                peer.Dispose();
            peer = null;
            openAt = clock.Elapsed.TotalSeconds + PauseS;
            if (serveAgain)
                return;
            enabled = false;
            if (Application.isBatchMode)
                Application.Quit();
        }
    }
}
