// Unity's physics behind the protocol: one PhysicsScene a lane, stepped by script. Never run in Unity itself so far:
// README.md says what was tested and what to check. For Unity 2021 and later.

using System.Collections.Generic;
using UnityEngine;
using UnityEngine.SceneManagement;
using Word = TubeCosim.Layout.ParameterIndex;
#if !UNITY_6000_0_OR_NEWER
using PhysicsMaterial = UnityEngine.PhysicMaterial;
#endif

namespace TubeCosim
{
    public sealed class UnityPlant : IPlant
    {
        private const float ContactOffset = 0.001f; // m; Unity reports collisions from this distance on
        private const float BounceThreshold = 1e-3f; // m/s; slower impacts do not bounce, 2 by default

        private readonly PlantDescription description;
        private readonly GameObject sceneTube;
        private readonly Dictionary<int, WallMesh> tubes = new Dictionary<int, WallMesh>();
        private UnityLane[] lanes = new UnityLane[0];
        private int innerSteps;
        private float h;

        // sceneTube stands in for the mesh of every registered tube, or null: the file itself is the wall.
        public UnityPlant(double speedMax, double[] defaults, GameObject sceneTube)
        {
            this.sceneTube = sceneTube;
            description = new PlantDescription
            {
                Name = "protocol.csharp.unity",
                Version = "1",
                Engine = "Unity " + Application.unityVersion,
                SpeedMax = speedMax,
                Defaults = defaults,
                Walls = true,
            };
        }

        public PlantDescription Describe()
        {
            return description;
        }

        public void Open(int count, double dt, double physicsDt, int innerSteps)
        {
            this.innerSteps = innerSteps;
            h = (float)(dt / innerSteps);
#if UNITY_2022_2_OR_NEWER
            Physics.simulationMode = SimulationMode.Script;
#else
            Physics.autoSimulation = false;
#endif
            Physics.defaultContactOffset = ContactOffset;
            Physics.bounceThreshold = BounceThreshold;
            lanes = new UnityLane[count];
            for (int lane = 0; lane < count; lane++)
                lanes[lane] = new UnityLane("TubeCosim lane " + Format.Of(lane));
        }

        public void RegisterTube(int index, TubeReference tube)
        {
            tubes[index] = WallMesh.Read(tube); // also where the scene has the wall: the agent sees the file's
        }

        public void ReleaseTube(int index)
        {
            tubes.Remove(index);
        }

        public void Reset(LaneReset[] resets, LanePose[] poses)
        {
            foreach (LaneReset reset in resets)
            {
                WallMesh wall;
                tubes.TryGetValue(reset.Tube, out wall);
                lanes[reset.Lane].Build(reset, wall, sceneTube);
                poses[reset.Lane] = lanes[reset.Lane].Read();
            }
        }

        public void Step(LaneCommand[] commands, LanePose[] poses)
        {
            for (int lane = 0; lane < lanes.Length; lane++)
                poses[lane] = lanes[lane].Step(commands[lane], innerSteps, h);
        }

        public void Close()
        {
            foreach (UnityLane lane in lanes)
                if (lane != null)
                    lane.Close();
            lanes = new UnityLane[0];
            tubes.Clear();
        }
    }

    // One world: a scene with physics of its own, in it the wall and the body.
    internal sealed class UnityLane
    {
        private const float MaxAngularVelocity = 1000f; // rad/s; Unity's own limit is 7
        private static int scenes; // their names must differ

        private readonly Scene scene;
        private readonly PhysicsScene physics;
        private readonly List<Object> built = new List<Object>(); // by the last reset
        private LaneReset reset;
        private Rigidbody body;
        private ContactSensor contact;

        public UnityLane(string name)
        {
            scene = SceneManager.CreateScene(name + ", " + Format.Of(scenes++),
                new CreateSceneParameters(LocalPhysicsMode.Physics3D));
            physics = scene.GetPhysicsScene();
        }

        // Builds everything anew, so that nothing of the lane's past remains.
        public void Build(LaneReset wanted, WallMesh wall, GameObject sceneTube)
        {
            Clear();
            reset = wanted;
            PhysicsMaterial material = new PhysicsMaterial // of body and wall: Unity takes the average of both
            {
                bounciness = (float)Parameter(Word.Restitution),
                dynamicFriction = (float)Parameter(Word.Friction),
                staticFriction = (float)Parameter(Word.Friction),
            };
            built.Add(material);
            if (wall != null && sceneTube != null)
                CopyWall(sceneTube, material);
            else if (wall != null)
                BuildWall(wall, material);
            BuildBody(material);
            Physics.SyncTransforms();
        }

        public LanePose Step(LaneCommand command, int innerSteps, float h)
        {
            double[] parameters = reset.Parameters;
            Vector3 gravity = new Vector3(0f, -(float)Parameter(Word.Gravity), 0f);
            if (Physics.gravity != gravity)
                Physics.gravity = gravity; // of all scenes; only this one is simulated until the next lane's turn
            Vector3d gust = ForceLaw.Gust(reset.Seed, command.Step, Parameter(Word.Gust));
            int contactSteps = 0;
            for (int i = 0; i < innerSteps; i++)
            {
                LanePose pose = Read();
                Vector3d torque = ForceLaw.Torque(pose, command, parameters)
                    + ForceLaw.Gyroscopic(pose, parameters); // Unity's engine leaves that one out
                body.AddForce(ToUnity(Frames.Vector(ForceLaw.Force(pose, command, parameters, gust))));
                body.AddTorque(ToUnity(Frames.Spin(torque)));
                contact.Touched = false;
                physics.Simulate(h);
                contactSteps += contact.Touched ? 1 : 0;
            }
            LanePose last = Read();
            last.ContactSteps = contactSteps;
            return last;
        }

        public LanePose Read()
        {
            Quaternion rotation = body.rotation;
            return new LanePose
            {
                Position = Frames.Vector(FromUnity(body.position)),
                Rotation = Frames.Rotation(
                    new Quaterniond(rotation.x, rotation.y, rotation.z, rotation.w).Normalized()),
                LinearVelocity = Frames.Vector(FromUnity(Velocity)),
                AngularVelocity = Frames.Spin(FromUnity(body.angularVelocity)),
            };
        }

        public void Close()
        {
            Clear();
            SceneManager.UnloadSceneAsync(scene);
        }

        private void Clear()
        {
            foreach (Object each in built)
                Object.DestroyImmediate(each);
            built.Clear();
        }

        private double Parameter(int index)
        {
            return reset.Parameters[index];
        }

        private void BuildBody(PhysicsMaterial material)
        {
            GameObject drone = Place(new GameObject("TubeCosim drone"));
            LanePose pose = reset.Pose;
            Quaterniond rotation = Frames.Rotation(pose.Rotation);
            drone.transform.position = ToUnity(Frames.Vector(pose.Position));
            drone.transform.rotation = new Quaternion((float)rotation.X, (float)rotation.Y, (float)rotation.Z,
                (float)rotation.W);
            SphereCollider sphere = drone.AddComponent<SphereCollider>();
            sphere.radius = (float)Parameter(Word.BodyRadius);
            sphere.sharedMaterial = material;
            contact = drone.AddComponent<ContactSensor>();
            body = drone.AddComponent<Rigidbody>();
            body.mass = (float)Parameter(Word.Mass);
            body.centerOfMass = Vector3.zero;
            body.inertiaTensor = ToUnity(Frames.Inertia(new Vector3d(Parameter(Word.InertiaX),
                Parameter(Word.InertiaY), Parameter(Word.InertiaZ))));
            body.inertiaTensorRotation = Quaternion.identity;
            body.useGravity = true;
            body.interpolation = RigidbodyInterpolation.None;
            body.sleepThreshold = 0f; // no body sleeps
            body.maxAngularVelocity = MaxAngularVelocity;
            SetNoDamping();
            Velocity = ToUnity(Frames.Vector(pose.LinearVelocity));
            body.angularVelocity = ToUnity(Frames.Spin(pose.AngularVelocity));
        }

        // The surface itself, hollow. PhysX takes triangles from their front alone, hence both windings.
        private void BuildWall(WallMesh wall, PhysicsMaterial material)
        {
            GameObject tube = Place(new GameObject("TubeCosim tube"));
            Vector3[] vertices = new Vector3[wall.Vertices.Length];
            for (int i = 0; i < vertices.Length; i++)
                vertices[i] = ToUnity(Frames.Vector(wall.Vertices[i]));
            int[] reversed = (int[])wall.Triangles.Clone();
            System.Array.Reverse(reversed);
            foreach (int[] triangles in new[] { wall.Triangles, reversed })
            {
                Mesh mesh = new Mesh { indexFormat = UnityEngine.Rendering.IndexFormat.UInt32 };
                mesh.vertices = vertices;
                mesh.triangles = triangles;
                MeshCollider surface = tube.AddComponent<MeshCollider>();
                surface.convex = false;
                surface.sharedMaterial = material;
                surface.sharedMesh = mesh;
                built.Add(mesh);
            }
        }

        private void CopyWall(GameObject sceneTube, PhysicsMaterial material)
        {
            GameObject tube = Place(Object.Instantiate(sceneTube));
            foreach (Collider surface in tube.GetComponentsInChildren<Collider>())
                surface.sharedMaterial = material;
        }

        private GameObject Place(GameObject thing)
        {
            built.Add(thing);
            SceneManager.MoveGameObjectToScene(thing, scene);
            return thing;
        }

        private static Vector3 ToUnity(Vector3d v)
        {
            return new Vector3((float)v.X, (float)v.Y, (float)v.Z);
        }

        private static Vector3d FromUnity(Vector3 v)
        {
            return new Vector3d(v.x, v.y, v.z);
        }

        // What Unity 6 has renamed.
#if UNITY_6000_0_OR_NEWER
        private Vector3 Velocity
        {
            get { return body.linearVelocity; }
            set { body.linearVelocity = value; }
        }

        private void SetNoDamping()
        {
            body.linearDamping = 0f;
            body.angularDamping = 0f;
        }
#else
        private Vector3 Velocity
        {
            get { return body.velocity; }
            set { body.velocity = value; }
        }

        private void SetNoDamping()
        {
            body.drag = 0f;
            body.angularDrag = 0f;
        }
#endif
    }

    // Notes that the body touched something during the last inner step; Unity calls it within Simulate.
    internal sealed class ContactSensor : MonoBehaviour
    {
        internal bool Touched;

        private void OnCollisionEnter(Collision collision)
        {
            Touched = true;
        }

        private void OnCollisionStay(Collision collision)
        {
            Touched = true;
        }
    }
}
