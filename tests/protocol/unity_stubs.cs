// A stand-in for the parts of Unity that protocol/csharp/unity uses, so that it can be compiled and flown here: types
// and members by the names and types of Unity's documentation, and a naive engine in floats behind them. Like PhysX it
// has walls that are felt from their front alone, no gyroscopic torque, and a left-handed frame with Y up.

using System;
using System.Collections.Generic;
using System.Reflection;
using UnityEngine.SceneManagement;

namespace UnityEngine
{
    public struct Vector3
    {
        public float x, y, z;

        public Vector3(float x, float y, float z)
        {
            this.x = x;
            this.y = y;
            this.z = z;
        }

        public static readonly Vector3 zero = new Vector3();

        public static Vector3 operator +(Vector3 a, Vector3 b)
        {
            return new Vector3(a.x + b.x, a.y + b.y, a.z + b.z);
        }

        public static Vector3 operator -(Vector3 a, Vector3 b)
        {
            return new Vector3(a.x - b.x, a.y - b.y, a.z - b.z);
        }

        public static Vector3 operator *(float k, Vector3 a)
        {
            return new Vector3(k * a.x, k * a.y, k * a.z);
        }

        public static bool operator ==(Vector3 a, Vector3 b)
        {
            return a.x == b.x && a.y == b.y && a.z == b.z;
        }

        public static bool operator !=(Vector3 a, Vector3 b)
        {
            return !(a == b);
        }

        public static float Dot(Vector3 a, Vector3 b)
        {
            return a.x * b.x + a.y * b.y + a.z * b.z;
        }

        public static Vector3 Cross(Vector3 a, Vector3 b)
        {
            return new Vector3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
        }

        public float magnitude
        {
            get { return (float)Math.Sqrt(Dot(this, this)); }
        }

        public override bool Equals(object other)
        {
            return other is Vector3 && this == (Vector3)other;
        }

        public override int GetHashCode()
        {
            return x.GetHashCode() ^ y.GetHashCode() ^ z.GetHashCode();
        }
    }

    public struct Quaternion
    {
        public float x, y, z, w;

        public Quaternion(float x, float y, float z, float w)
        {
            this.x = x;
            this.y = y;
            this.z = z;
            this.w = w;
        }

        public static readonly Quaternion identity = new Quaternion(0f, 0f, 0f, 1f);

        public static Quaternion Inverse(Quaternion q)
        {
            return new Quaternion(-q.x, -q.y, -q.z, q.w);
        }

        public static Quaternion operator *(Quaternion a, Quaternion b)
        {
            Vector3 u = new Vector3(a.x, a.y, a.z), v = new Vector3(b.x, b.y, b.z);
            Vector3 s = a.w * v + b.w * u + Vector3.Cross(u, v);
            return new Quaternion(s.x, s.y, s.z, a.w * b.w - Vector3.Dot(u, v));
        }

        public static Vector3 operator *(Quaternion q, Vector3 v)
        {
            Vector3 u = new Vector3(q.x, q.y, q.z), t = 2f * Vector3.Cross(u, v);
            return v + q.w * t + Vector3.Cross(u, t);
        }

        public Quaternion normalized
        {
            get
            {
                float length = (float)Math.Sqrt(x * x + y * y + z * z + w * w);
                return new Quaternion(x / length, y / length, z / length, w / length);
            }
        }
    }

    public class Object
    {
        public static void DestroyImmediate(Object thing)
        {
            GameObject gone = thing as GameObject;
            if (gone != null)
                gone.scene.things.Remove(gone);
        }

        public static T Instantiate<T>(T original) where T : Object
        {
            throw new NotSupportedException("the stand-in has no scenes of its own");
        }
    }

    public class Component : Object
    {
        public GameObject gameObject { get; internal set; }

        public Transform transform
        {
            get { return gameObject.transform; }
        }
    }

    public class Behaviour : Component
    {
        public bool enabled { get; set; }
    }

    public class MonoBehaviour : Behaviour
    {
    }

    public sealed class Transform : Component
    {
        public Vector3 position { get; set; }
        public Quaternion rotation { get; set; }
    }

    public sealed class GameObject : Object
    {
        internal readonly List<Component> components = new List<Component>();

        public Transform transform { get; private set; }
        public Scene scene { get; internal set; }

        public GameObject(string name)
        {
            transform = new Transform { rotation = Quaternion.identity };
        }

        public T AddComponent<T>() where T : Component
        {
            T component = (T)Activator.CreateInstance(typeof(T), true);
            component.gameObject = this;
            components.Add(component);
            return component;
        }

        public T[] GetComponentsInChildren<T>()
        {
            List<T> found = new List<T>();
            foreach (object component in components)
                if (component is T)
                    found.Add((T)component);
            return found.ToArray();
        }

        internal T Find<T>() where T : Component
        {
            T[] found = GetComponentsInChildren<T>();
            return found.Length > 0 ? found[0] : null;
        }

        // Calls a private message method, as Unity does.
        internal void Send(string message, params object[] arguments)
        {
            foreach (Component component in components)
            {
                MethodInfo method = component.GetType().GetMethod(message,
                    BindingFlags.Instance | BindingFlags.NonPublic | BindingFlags.Public);
                if (method != null && component is MonoBehaviour)
                    method.Invoke(component, arguments);
            }
        }
    }

    public enum RigidbodyInterpolation
    {
        None,
        Interpolate,
    }

    public sealed class Rigidbody : Component
    {
        internal Vector3 force, torque;

        public float mass { get; set; }
        public Vector3 centerOfMass { get; set; }
        public Vector3 inertiaTensor { get; set; }
        public Quaternion inertiaTensorRotation { get; set; }
        public bool useGravity { get; set; }
        public RigidbodyInterpolation interpolation { get; set; }
        public float sleepThreshold { get; set; }
        public float maxAngularVelocity { get; set; }
        public Vector3 angularVelocity { get; set; }
#if UNITY_6000_0_OR_NEWER
        public Vector3 linearVelocity { get; set; }
        public float linearDamping { get; set; }
        public float angularDamping { get; set; }

        internal Vector3 v
        {
            get { return linearVelocity; }
            set { linearVelocity = value; }
        }
#else
        public Vector3 velocity { get; set; }
        public float drag { get; set; }
        public float angularDrag { get; set; }

        internal Vector3 v
        {
            get { return velocity; }
            set { velocity = value; }
        }
#endif

        public Vector3 position
        {
            get { return transform.position; }
        }

        public Quaternion rotation
        {
            get { return transform.rotation; }
        }

        public void AddForce(Vector3 more)
        {
            force += more;
        }

        public void AddTorque(Vector3 more)
        {
            torque += more;
        }

        internal void Integrate(float h)
        {
            v += h * ((1f / mass) * force + (useGravity ? Physics.gravity : Vector3.zero));
            Vector3 body = Quaternion.Inverse(rotation) * torque;
            body = new Vector3(body.x / inertiaTensor.x, body.y / inertiaTensor.y, body.z / inertiaTensor.z);
            angularVelocity += h * (rotation * body);
            if (angularVelocity.magnitude > maxAngularVelocity)
                throw new InvalidOperationException("faster than maxAngularVelocity");
            force = torque = Vector3.zero;
        }

        internal void Move(float h)
        {
            transform.position += h * v;
            double rate = angularVelocity.magnitude, half = 0.5 * h * rate;
            float s = rate > 0.0 ? (float)(Math.Sin(half) / rate) : 0f;
            Vector3 axis = s * angularVelocity;
            transform.rotation =
                (new Quaternion(axis.x, axis.y, axis.z, (float)Math.Cos(half)) * rotation).normalized;
        }
    }

    public class Collider : Component
    {
#if UNITY_6000_0_OR_NEWER
        public PhysicsMaterial sharedMaterial { get; set; }
#else
        public PhysicMaterial sharedMaterial { get; set; }
#endif
    }

    public sealed class SphereCollider : Collider
    {
        public float radius { get; set; }
    }

    public sealed class MeshCollider : Collider
    {
        public bool convex { get; set; }
        public Mesh sharedMesh { get; set; }
    }

#if UNITY_6000_0_OR_NEWER
    public sealed class PhysicsMaterial : Object
#else
    public sealed class PhysicMaterial : Object
#endif
    {
        public float bounciness { get; set; }
        public float dynamicFriction { get; set; }
        public float staticFriction { get; set; }
    }

    public sealed class Mesh : Object
    {
        public Rendering.IndexFormat indexFormat { get; set; }
        public Vector3[] vertices { get; set; }
        public int[] triangles { get; set; }
    }

    public sealed class Collision
    {
    }

#if UNITY_2022_2_OR_NEWER
    public enum SimulationMode
    {
        FixedUpdate,
        Update,
        Script,
    }
#endif

    public static class Physics
    {
        public static Vector3 gravity { get; set; }
        public static float defaultContactOffset { get; set; }
        public static float bounceThreshold { get; set; }
#if UNITY_2022_2_OR_NEWER
        public static SimulationMode simulationMode { get; set; }
#else
        public static bool autoSimulation { get; set; }
#endif

        public static void SyncTransforms()
        {
        }
    }

    public struct PhysicsScene
    {
        internal Scene scene;

        // One step of every body; a wall that it touches throws it back.
        public void Simulate(float step)
        {
            foreach (GameObject thing in scene.things)
            {
                Rigidbody body = thing.Find<Rigidbody>();
                if (body == null)
                    continue;
                body.Integrate(step);
                foreach (GameObject other in scene.things)
                    foreach (MeshCollider wall in other.GetComponentsInChildren<MeshCollider>())
                        if (ThrowBack(body, wall))
                            thing.Send("OnCollisionStay", new Collision());
                body.Move(step);
            }
        }

        private static bool ThrowBack(Rigidbody body, MeshCollider wall)
        {
            SphereCollider sphere = body.gameObject.Find<SphereCollider>();
            float reach = sphere.radius + Physics.defaultContactOffset;
            Vector3[] corners = wall.sharedMesh.vertices;
            int[] indices = wall.sharedMesh.triangles;
            bool touched = false;
            for (int i = 0; i < indices.Length; i += 3)
            {
                Vector3 a = corners[indices[i]], b = corners[indices[i + 1]], c = corners[indices[i + 2]];
                Vector3 front = Vector3.Cross(b - a, c - a), apart = body.position - Closest(body.position, a, b, c);
                float distance = apart.magnitude, inward = Vector3.Dot(body.v, apart) / distance;
                if (distance > reach || Vector3.Dot(front, body.position - a) < 0f)
                    continue;
                touched = true;
                body.transform.position += (Math.Max(0f, sphere.radius - distance) / distance) * apart;
                if (inward < 0f)
                    body.v -= ((1f + sphere.sharedMaterial.bounciness) * inward / distance) * apart;
            }
            return touched;
        }

        // The point of a triangle that is closest to p: inside of it, or on one of its edges.
        private static Vector3 Closest(Vector3 p, Vector3 a, Vector3 b, Vector3 c)
        {
            Vector3 front = Vector3.Cross(b - a, c - a);
            Vector3 foot = p - (Vector3.Dot(front, p - a) / Vector3.Dot(front, front)) * front;
            if (Vector3.Dot(front, Vector3.Cross(b - a, foot - a)) >= 0f
                && Vector3.Dot(front, Vector3.Cross(c - b, foot - b)) >= 0f
                && Vector3.Dot(front, Vector3.Cross(a - c, foot - c)) >= 0f)
                return foot;
            Vector3 best = OnEdge(p, a, b), second = OnEdge(p, b, c), third = OnEdge(p, c, a);
            best = (p - second).magnitude < (p - best).magnitude ? second : best;
            return (p - third).magnitude < (p - best).magnitude ? third : best;
        }

        private static Vector3 OnEdge(Vector3 p, Vector3 a, Vector3 b)
        {
            float along = Vector3.Dot(p - a, b - a) / Vector3.Dot(b - a, b - a);
            return a + Math.Max(0f, Math.Min(1f, along)) * (b - a);
        }
    }

    public static class PhysicsSceneExtensions
    {
        public static PhysicsScene GetPhysicsScene(this Scene scene)
        {
            return new PhysicsScene { scene = scene };
        }
    }

    public sealed class AsyncOperation
    {
    }

    public static class Application
    {
        public static bool runInBackground { get; set; }

        public static bool isBatchMode
        {
            get { return true; }
        }

        public static string unityVersion
        {
            get { return "stand-in"; }
        }

        internal static bool hasQuit;

        public static void Quit()
        {
            hasQuit = true;
        }
    }

    public static class Debug
    {
        public static void Log(object message)
        {
            Console.Error.WriteLine(message);
        }

        public static void LogError(object message)
        {
            Console.Error.WriteLine(message);
        }

        public static void LogException(Exception error)
        {
            Console.Error.WriteLine(error);
        }
    }

    public sealed class TooltipAttribute : Attribute
    {
        public TooltipAttribute(string tooltip)
        {
        }
    }
}

namespace UnityEngine.Rendering
{
    public enum IndexFormat
    {
        UInt16,
        UInt32,
    }
}

namespace UnityEngine.SceneManagement
{
    [Flags]
    public enum LocalPhysicsMode
    {
        None = 0,
        Physics2D = 1,
        Physics3D = 2,
    }

    public struct CreateSceneParameters
    {
        public CreateSceneParameters(LocalPhysicsMode physicsMode)
        {
        }
    }

    public struct Scene
    {
        internal List<GameObject> things;
    }

    public static class SceneManager
    {
        public static Scene CreateScene(string sceneName, CreateSceneParameters parameters)
        {
            return new Scene { things = new List<GameObject>() };
        }

        public static void MoveGameObjectToScene(GameObject go, Scene scene)
        {
            go.scene = scene;
            scene.things.Add(go);
        }

        public static AsyncOperation UnloadSceneAsync(Scene scene)
        {
            return new AsyncOperation();
        }
    }
}

// Plays one scene with the server in it, frame by frame: `mono unity.exe RENDEZVOUS`.
public static class Player
{
    public static void Main(string[] arguments)
    {
        TubeCosim.Signals.Catch();
        UnityEngine.GameObject thing = new UnityEngine.GameObject("server");
        TubeCosim.UnityPhysicsServer server = thing.AddComponent<TubeCosim.UnityPhysicsServer>();
        server.serveAgain = false;
        server.enabled = true;
        thing.Send("Start");
        while (server.enabled && TubeCosim.Signals.WhyToStop() == null)
        {
            thing.Send("Update");
            System.Threading.Thread.Sleep(1); // the rest of a frame
        }
        thing.Send("OnDestroy");
    }
}
